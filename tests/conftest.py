"""All tests run in float64, which the package itself never switches on.

Compiled programs are kept in .cache/jax, so that test processes, the command line and notebooks
share them; a process drops its own after every file, because each holds memory maps, of which
the system allows 65 530 a process.
"""

import os
from pathlib import Path

ROOT = Path(__file__).parent.parent
EXAMPLES = ROOT / "examples"

os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(ROOT / ".cache" / "jax"))
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0.3")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import jax  # noqa: E402
import pytest  # noqa: E402

jax.config.update("jax_enable_x64", True)


@pytest.fixture(scope="module", autouse=True)
def drop_compiled_programs():
    yield
    jax.clear_caches()


@pytest.fixture(scope="session")
def convergent4():
    """The four convergent photographs, all ten parameters free, adjusted once."""
    import jaxbundle

    return jaxbundle.adjust(jaxbundle.read_network(EXAMPLES / "convergent4" / "project.toml"))
