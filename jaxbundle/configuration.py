"""How JAX is to work: 64-bit floats, cores, the compiler; only when it is asked for."""

import os
from importlib.metadata import version

QUICK_LOOPS = "--xla_cpu_use_fusion_emitters=false"
"""XLA writes loops in the older of its two ways: compiled in half the time and memory, as fast."""


def enable_x64() -> None:
    """Switch JAX to the 64-bit floats adjustment needs; call it before the first JAX computation.

    The compiler is set up for the processor, too, where it still has the choice (jaxlib 0.10):
    `QUICK_LOOPS` is put into the environment variable XLA_FLAGS, unless that speaks of it.
    """
    import jax

    flags = os.environ.get("XLA_FLAGS", "")
    if version("jaxlib").startswith("0.10.") and "fusion_emitters" not in flags:
        os.environ["XLA_FLAGS"] = f"{flags} {QUICK_LOOPS}".strip()
    jax.config.update("jax_enable_x64", True)


def use_cores(number: int | None = None) -> None:
    """Let the cores of the processor (all, or so many) share the work on big networks, as devices
    of JAX; call it before the first JAX computation."""
    import jax

    jax.config.update("jax_num_cpu_devices", number or available_cores())


def available_cores() -> int:
    """Cores this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1
