"""64-bit floats: the only module that enables, requires or checks them.

| who | what |
|---|---|
| importing the package | changes nothing |
| the user, once; the command line | `enable_x64()`, before the first JAX computation |
| functions that return coordinates, orientations, calibrations | `require_x64()`: an error without
|
| NumPy in, NumPy out: reading, writing and converting files and cameras | `with local_x64():` |
| formulas of one point, ray or exchange | nothing: they compute in the type of their arguments |

Hence files can be read, converted and compared without enabling 64-bit floats.
"""

import os
from contextlib import AbstractContextManager
from importlib.metadata import version

QUICK_LOOPS = "--xla_cpu_use_fusion_emitters=false"
"""Use the older of XLA's two loop emitters: half the compile time and memory, the same speed."""
ONE_AFTER_THE_OTHER = "--xla_cpu_enable_concurrency_optimized_scheduler=false"
"""Disable concurrent operations in XLA's thread pool. jaxlib waits there for the parts of a batched
factorisation or triangular solve: as many of them at once as there are threads, as under `vmap`,
deadlock. Programs are equally fast, and smaller."""
LITTLE_OPTIMISATION = "--xla_backend_optimization_level=0"
"""Half the compile time; programs take three to five times as long."""


def enable_x64(*, compile_quickly: bool = False) -> None:
    """Switch JAX to the required 64-bit floats; call it before the first JAX computation.

    It also sets the CPU compiler options `QUICK_LOOPS` and `ONE_AFTER_THE_OTHER` in the environment
    variable XLA_FLAGS (jaxlib 0.10), unless the variable already sets them.

    `compile_quickly`: also `LITTLE_OPTIMISATION`, for a process that computes one small problem,
    such as `jaxbundle adjust` of up to some 3000 image points.
    """
    import jax

    if version("jaxlib").startswith("0.10."):
        flags = os.environ.get("XLA_FLAGS", "").split()
        said = {flag.partition("=")[0] for flag in flags}
        ours = [QUICK_LOOPS, ONE_AFTER_THE_OTHER, *[LITTLE_OPTIMISATION] * compile_quickly]
        ours = [flag for flag in ours if flag.partition("=")[0] not in said]
        os.environ["XLA_FLAGS"] = " ".join(flags + ours)
    jax.config.update("jax_enable_x64", True)


def require_x64() -> None:
    """Require 64-bit floats.

    **Raises:** `RuntimeError` that says how to get them."""
    import jax

    if not jax.config.read("jax_enable_x64"):
        raise RuntimeError(
            "jaxbundle computes in 64-bit floating point. Call jaxbundle.enable_x64() before the "
            "first JAX computation, or set the environment variable JAX_ENABLE_X64=1."
        )


def local_x64() -> AbstractContextManager:
    """64-bit floats for the computations inside the context."""
    import jax

    return jax.enable_x64(True)
