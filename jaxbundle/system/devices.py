"""What depends on the kind of device that JAX computes on."""

import jax


def on_accelerator() -> bool:
    """Whether JAX's default device is not a processor."""
    return jax.default_backend() != "cpu"


def batch_size(processor: int, accelerator: int) -> int:
    """How many rows one step of a loop takes.

    The arrays of few rows stay in a processor's cache. On an accelerator every step of a loop costs
    the start of its kernels (about 5 µs each on an H100), however few rows it has, so that many rows
    share it.
    """
    return accelerator if on_accelerator() else processor
