"""What depends on the kind of device that JAX computes on."""

import jax


def on_accelerator() -> bool:
    """Whether JAX's default device is not a processor."""
    return jax.default_backend() != "cpu"


def batch_size(processor: int, accelerator: int) -> int:
    """How many rows one step of a loop takes.

    The arrays of few rows stay in a processor's cache. On an accelerator every step costs the start
    of its kernels, however few rows it has: with the steps of a processor a search of 4 million
    points took 0.42 s on an H100, with those of an accelerator 0.005 (benchmarks/gpu.py, "back").
    """
    return accelerator if on_accelerator() else processor
