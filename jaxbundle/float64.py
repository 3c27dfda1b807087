"""64-bit floats: one rule, and the only place that switches, refuses or checks.

| who | what |
|---|---|
| importing the package | switches nothing |
| the user, once; the command line | `enable_x64()`, before the first JAX computation |
| whatever ends in coordinates, orientations, calibrations | `require_x64()`: refuses without |
| NumPy in, NumPy out: reading, writing and converting files and cameras | `with local_x64():` |
| formulas of one point, ray or exchange | nothing: they compute in the type of their arguments |

Files can so be read, converted and compared before anything is switched on.
"""

import os
from contextlib import AbstractContextManager
from importlib.metadata import version

QUICK_LOOPS = "--xla_cpu_use_fusion_emitters=false"
"""XLA writes loops in the older of its two ways: compiled in half the time and memory, as fast."""
ONE_AFTER_THE_OTHER = "--xla_cpu_enable_concurrency_optimized_scheduler=false"
"""The operations of a program do not wait for each other inside XLA's pool of threads. jaxlib does
so for the parts of a batched factorisation or triangular solve: as many of them at once as there
are threads, as under `vmap`, wait for ever. Programs are as fast, and smaller."""


def enable_x64() -> None:
    """Switch JAX to the 64-bit floats adjustment needs; call it before the first JAX computation.

    The compiler is set up for the processor, too, where it still has the choice (jaxlib 0.10):
    `QUICK_LOOPS` and `ONE_AFTER_THE_OTHER` are put into the environment variable XLA_FLAGS, each
    unless that speaks of it.
    """
    import jax

    if version("jaxlib").startswith("0.10."):
        flags = os.environ.get("XLA_FLAGS", "").split()
        said = {flag.partition("=")[0] for flag in flags}
        ours = [f for f in (QUICK_LOOPS, ONE_AFTER_THE_OTHER) if f.partition("=")[0] not in said]
        os.environ["XLA_FLAGS"] = " ".join(flags + ours)
    jax.config.update("jax_enable_x64", True)


def require_x64() -> None:
    """64-bit floats, without which nothing is adjusted.

    **Raises:** `RuntimeError` that says how to get them."""
    import jax

    if not jax.config.read("jax_enable_x64"):
        raise RuntimeError(
            "jaxbundle computes in 64-bit floating point. Call jaxbundle.enable_x64() before the "
            "first JAX computation, or set the environment variable JAX_ENABLE_X64=1."
        )


def local_x64() -> AbstractContextManager:
    """64-bit floats for the computations inside, whatever the rest of the program has."""
    import jax

    return jax.enable_x64(True)
