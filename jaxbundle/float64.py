"""64-bit floats: the only module that enables, requires or checks them.

| who | what |
|---|---|
| importing the package | changes nothing |
| the user, once; the command line | `enable_x64()`, before the first JAX computation |
| functions that return coordinates, orientations, calibrations | `require_x64()`: an error if not |
| NumPy in, NumPy out: reading, writing and converting files and cameras | `with local_x64():` |
| formulas of one point, ray or exchange | nothing: they compute in the type of their arguments |

Hence files can be read, converted and compared without enabling 64-bit floats.
"""

from contextlib import AbstractContextManager

from jaxbundle.system.xla_flags import set_flags


def enable_x64(*, compile_quickly: bool = False) -> None:
    """Switch JAX to the required 64-bit floats; call it before the first JAX computation.

    It also adds options of the CPU compiler to the environment variable XLA_FLAGS, unless it
    already sets them (`system.xla_flags`).

    `compile_quickly`: also one for little optimisation, for a process that computes one small
    problem, such as `jaxbundle adjust` of up to some 3000 image points.
    """
    import jax

    set_flags(compile_quickly)
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
