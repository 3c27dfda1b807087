"""Compiled programs kept for later processes: commands in processes of their own, with an empty
home, cold and warm. Keeping them changes no number, prints nothing and ends no command."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from jaxbundle.system.xla_flags import jaxlib_version

ROOT = Path(__file__).parents[1]
SHARED = ROOT.parent / "shared" / "data" / "real" / "small" / "recursion_models"
KEEPS = jaxlib_version() >= (0, 10, 2)
kept_only = pytest.mark.skipif(not KEEPS, reason="before jaxlib 0.10.2 no programs are kept")
MODELS = (
    "kannala-brandt-tangential", "thin-prism-fisheye", "rad-tan-thin-prism-fisheye",
    "radial-spline-6-120", "spline-6x5-120",
)  # fmt: skip
"""Camera models with a derivative rule of their own, or made on request."""
LINES = """
import shlex, sys
from jaxbundle import cli
from jaxbundle.__main__ import _keep_programs
sys.stderr = sys.stdout
for line in sys.argv[1:]:
    sys.argv = ["jaxbundle", *shlex.split(line)]
    print("==", line)
    try:
        cli.main(_keep_programs)
    except SystemExit as ended:
        print("status", ended.code or 0)
"""
"""Command lines, one after another in one process, with programs kept as on the command line."""
SMALL = """
import jax, jaxbundle
jaxbundle.enable_x64()
assert jaxbundle.keep_programs() == KEPT
for n in range(1, 9):
    assert jax.jit(lambda x: n * x + 1)(1.0) == n + 1
"""


@pytest.fixture
def home(tmp_path):
    """An empty home, as the environment of a process."""
    ours = ("JAX_", "XLA_", "XDG_")
    environment = {k: v for k, v in os.environ.items() if not k.startswith(ours)}
    folder = tmp_path / "home"
    folder.mkdir()
    return environment | {
        "HOME": str(folder), "PYTHONPATH": str(ROOT),
        "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
    }  # fmt: skip


def begin(code, *arguments, environment, options=()):
    return subprocess.Popen(
        [sys.executable, *options, "-c", code, *map(str, arguments)], env=environment, text=True,
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, cwd=environment["HOME"],
    )  # fmt: skip


def run(code, *arguments, environment, options=()):
    """The output of a process that ends well and has nothing to report."""
    process = begin(code, *arguments, environment=environment, options=options)
    out, err = process.communicate()
    assert (process.returncode, err) == (0, "")
    return out


def programs(environment) -> list[Path]:
    return sorted(Path(environment["HOME"]).glob(".cache/jaxbundle/*-cache"))


def run_twice(lines, environment) -> str:
    """The output of command lines that all succeed and say the same in a second process, where
    programs are there."""
    first, second = (run(LINES, *lines, environment=environment) for _ in range(2))
    assert re.findall("status (.*)", first) == ["0"] * len(lines), first
    assert first == second and bool(programs(environment)) == KEEPS
    return first


@pytest.mark.further
def test_every_camera_model_can_be_kept(home, tmp_path):
    cameras = tmp_path / "cameras.toml"
    known = "fx = 600.0\nfy = 600.0\ncx = 320.0\ncy = 240.0\nimage_size = [640, 480]\n"
    cameras.write_text("".join(
        f'[[camera]]\nid = "{model}"\nmodel = "{model}"\n{known}' for model in MODELS
    ))  # fmt: skip
    said = run_twice([f"camera {cameras}#{model}" for model in MODELS], home)
    assert all(f"model {model}" in said for model in MODELS)


@pytest.mark.further
def test_line_scanners_draw_random_errors(home):
    run_twice([
        f"pushbroom simulate {ROOT}/examples/line_scanner/flight.toml --out simulated --force",
        "pushbroom accuracy simulated/scanner.toml --draws 20 --attitude-white 0.01",
    ], home)  # fmt: skip


@pytest.mark.skipif(not SHARED.is_dir(), reason="the folder ../shared/data/real is not here")
@pytest.mark.further
def test_models_of_real_files(home):
    lines = [f"camera {SHARED}/tp.toml#a", f"convert {SHARED}/tpcol out.csv --force"]
    assert "thin-prism-fisheye" in run_twice(lines, home)
    assert len(Path(home["HOME"], "out.csv").read_text().splitlines()) > 1


ADJUST = """
import sys, jaxbundle
jaxbundle.enable_x64(compile_quickly=True)
jaxbundle.keep_programs()
if "replaced" in sys.argv:
    from jaxbundle.leastsquares import spaces
    ray = spaces.Posed.ray
    def bent(*given):  # by nothing that a parameter of the camera can be
        x, y, z = ray(*given)
        return x + 0.1 * y**3 / z**2, y, z
    spaces.Posed.ray = bent
print(repr(jaxbundle.adjust(jaxbundle.read_network(sys.argv[1])).sigma0))
"""


@pytest.mark.further
def test_a_replaced_method_is_seen_by_a_later_process(home, convergent4):
    project = ROOT / "examples" / "convergent4" / "project.toml"
    first, again = (float(run(ADJUST, project, environment=home)) for _ in range(2))
    assert first == again == pytest.approx(convergent4.sigma0 / 0.0007, rel=1e-9)
    replaced = float(run(ADJUST, project, "replaced", environment=home))
    assert replaced != pytest.approx(first, rel=1e-3), "the old program was run"


@kept_only
def test_damaged_programs_are_compiled_again_and_replaced(home):
    code = f"KEPT = True\n{SMALL}"
    run(code, environment=home)
    files = programs(home)
    assert len(files) >= 8
    for number, file in enumerate(files):
        content = file.read_bytes()
        middle = len(content) // 2
        noise = content[:middle] + os.urandom(64) + content[middle + 64 :]
        file.write_bytes([b"", content[:middle], bytes(len(content)), noise][number % 4])
        os.utime(file, (0, 0))  # by a process that ended long ago
    run(code, environment=home, options=("-W", "error"))
    assert all(file.stat().st_mtime > 0 for file in files), "JAX alone does not replace them"


@kept_only
def test_a_full_disk_is_no_matter(home):
    full = "import resource\nresource.setrlimit(resource.RLIMIT_FSIZE, (500, 500))\n"
    code = f"KEPT = True\n{SMALL}"
    run(full + code, environment=home)
    for file in programs(home):
        assert file.stat().st_size <= 500
        os.utime(file, (0, 0))
    for _ in range(2):
        run(code, environment=home)
    assert programs(home) and all(file.stat().st_size > 500 for file in programs(home))


@pytest.mark.parametrize("place", ["read-only", "a file", "no home"])
def test_nothing_is_kept_where_nothing_can_be_written(home, tmp_path, place):
    if place == "read-only" and os.geteuid() == 0:
        folder = Path("/proc/jaxbundle")  # root may write into any other folder
    elif place == "no home":
        folder = tmp_path / "file" / "home"
        (tmp_path / "file").write_text("")
    else:
        folder = tmp_path / "folder"
        folder.write_text("") if place == "a file" else folder.mkdir(0o500)
    told = home | {"XDG_CACHE_HOME": str(folder)}
    run(f"KEPT = False\n{SMALL}", environment=told)


GONE = """
import os, shutil
shutil.rmtree(os.path.expanduser("~/.cache"), ignore_errors=True)
open(os.path.expanduser("~/.cache"), "w").close()
for n"""


def test_a_folder_that_vanishes_is_no_matter(home):
    code = SMALL.replace("\nfor n", GONE)
    run(f"KEPT = {KEEPS}\n{code}", environment=home)


@kept_only
def test_processes_at_once_share_a_folder(home):
    code = f"KEPT = True\n{SMALL}"
    for _ in range(2):
        together = [begin(code, environment=home) for _ in range(2)]
        for process in together:
            _, err = process.communicate()
            assert (process.returncode, err) == (0, "")
    assert len(programs(home)) >= 8
