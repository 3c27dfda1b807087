"""All tests run in float64, which the package itself never switches on.

Compiled programs are kept in .cache/jax, so that test processes, the command line and notebooks
share them; a process drops its own when it holds more than `MOST` after a test: a worker then stays
under 2 GB, and far from the 65 530 memory maps that Linux allows a process. Programs are compiled
with little optimisation, and in one piece (pieces for several threads cost an eighth more): here
compiling takes longer than running.
"""

import ctypes
import gc
import os
import signal
import sys
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).parent.parent
EXAMPLES = ROOT / "examples"

os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(ROOT / ".cache" / "jax"))
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0.05")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
# As on a user's machine: else every process that a test starts compiles the modules again, for two
# seconds of the processor.
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
sys.dont_write_bytecode = False
os.environ.setdefault(
    "XLA_FLAGS", "--xla_backend_optimization_level=0 --xla_cpu_parallel_codegen_split_count=1"
)

import jax  # noqa: E402
import pytest  # noqa: E402
from jaxtyping import install_import_hook  # noqa: E402
from type_checker import modules_with_shapes, unchecked  # noqa: E402

install_import_hook(modules_with_shapes(ROOT / "jaxbundle"), "type_checker.checked")

import jaxbundle  # noqa: E402
from jaxbundle import cli  # noqa: E402
from jaxbundle.__main__ import GC_THRESHOLDS  # noqa: E402

jaxbundle.enable_x64()

gc.freeze()
gc.set_threshold(*GC_THRESHOLDS)


# Where signals are ignored (in the background, under nohup), the programs that tests start would
# ignore them too; a handler is not inherited.
for name in ("SIGINT", "SIGHUP"):
    if signal.getsignal(getattr(signal, name, signal.SIGTERM)) is signal.SIG_IGN:
        signal.signal(getattr(signal, name), lambda *_: None)


TOGETHER, APART = ("tests/calibration/", "tests/refinement/"), ("tests/test_notebooks.py",)
"""Folders that go to one worker, and files of which every test goes to any."""


def work_unit(nodeid: str) -> str:
    """The unit given to one worker: a file, so that its fixtures are made once and its programs
    compiled once; a folder that shares more; a notebook, which is long."""
    path = nodeid.split("::")[0]
    if path in APART:
        return nodeid
    return next((folder for folder in TOGETHER if path.startswith(folder)), path)


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config, log):
    """By node ids: the groups of `--dist loadgroup` are lost by xdist 3.8 under pytest 9.2, which
    no longer lets a plugin rename a test."""
    from xdist.scheduler import LoadScopeScheduling

    class ByWorkUnit(LoadScopeScheduling):
        def _split_scope(self, nodeid):
            return work_unit(nodeid)

    return ByWorkUnit(config, log)


MEMORY = Path("/proc/self/statm")
MOST = 1.4e9
"""Bytes; a single test may add 0.4e9 before it ends, others ask for `memory_at_hand`."""
WORTH = 150e6
"""Bytes that have come since the last time, for another to be worth it."""


def memory() -> float:
    """Memory of this process, bytes; 0 where it is not known."""
    if not MEMORY.exists():
        return 0.0
    return int(MEMORY.read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")


held = memory()


def keep_freed_memory() -> None:
    """Arrays come from memory that was freed before, and threads share two heaps. By its defaults
    glibc gives large arrays back to the system at once, which clears their pages again for the
    next: of the tests that render photographs this took a third of the time."""
    if set_option := getattr(ctypes.CDLL(None), "mallopt", None):
        M_TRIM_THRESHOLD, M_MMAP_THRESHOLD, M_ARENA_MAX = -1, -3, -8
        set_option(M_MMAP_THRESHOLD, 32 << 20)  # the largest that glibc takes
        set_option(M_TRIM_THRESHOLD, 128 << 20)
        set_option(M_ARENA_MAX, 2)


keep_freed_memory()


def trim() -> None:
    """What was freed goes back to the system."""
    if give_back := getattr(ctypes.CDLL(None), "malloc_trim", None):
        give_back(0)


def drop_compiled_programs() -> None:
    global held
    jax.clear_caches()
    gc.collect()
    trim()
    held = memory()


@pytest.fixture(autouse=True)
def bound_memory():
    yield
    if memory() > max(MOST, held + WORTH):
        trim()
    if memory() > max(MOST, held + WORTH):
        drop_compiled_programs()


@pytest.fixture(scope="module")
def memory_at_hand():
    """For tests that need much of it."""
    drop_compiled_programs()


@pytest.fixture
def wrong_types():
    """For tests that pass values which annotations forbid, to check the message of the package."""
    with unchecked():
        yield


class Told(NamedTuple):
    """Output and exit status of a command line."""

    status: int
    out: str
    err: str


@pytest.fixture
def command(monkeypatch, capsys):
    """A command line in this process: importing JAX costs more than most commands."""
    monkeypatch.setattr(jaxbundle, "use_cores", lambda *_: None)  # JAX runs here already

    def run(*arguments) -> Told:
        monkeypatch.setattr(sys, "argv", ["jaxbundle", *map(str, arguments)])
        with pytest.raises(SystemExit) as ended:
            cli.main()
        return Told(ended.value.code or 0, *capsys.readouterr())

    return run


UNIT_WEIGHTS = ("sigma_image=1", "sigma_origin=unit")


@pytest.fixture(scope="session")
def convergent4():
    """The four convergent photographs, all ten parameters free, adjusted once; unit weights, as in
    the published figures."""
    project = EXAMPLES / "convergent4" / "project.toml"
    return jaxbundle.adjust(jaxbundle.read_network(project, overrides=UNIT_WEIGHTS))
