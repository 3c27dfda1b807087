"""All tests run in float64, which the package itself never switches on.

Compiled programs are kept in .cache/jax, so that test processes, the command line and notebooks
share them; a process drops its own after a file of tests when it holds many, because each takes
memory maps, of which Linux allows 65 530 a process. Programs are compiled with little optimisation:
here compiling takes longer than running.
"""

import os
from pathlib import Path

ROOT = Path(__file__).parent.parent
EXAMPLES = ROOT / "examples"

os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(ROOT / ".cache" / "jax"))
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0.05")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("XLA_FLAGS", "--xla_backend_optimization_level=0")

import jax  # noqa: E402
import pytest  # noqa: E402

import jaxbundle  # noqa: E402

jaxbundle.enable_x64()


MAPS = Path("/proc/self/maps")
MANY_MAPS = 20_000


@pytest.fixture(scope="module", autouse=True)
def drop_compiled_programs():
    yield
    if not MAPS.exists() or MAPS.read_bytes().count(b"\n") > MANY_MAPS:
        jax.clear_caches()


@pytest.fixture(scope="session")
def convergent4():
    """The four convergent photographs, all ten parameters free, adjusted once."""
    return jaxbundle.adjust(jaxbundle.read_network(EXAMPLES / "convergent4" / "project.toml"))
