"""A simulated full disk."""

import resource
import signal
from contextlib import contextmanager

import jax


@contextmanager
def files_end_at(size: int):
    """No file grows beyond this number of bytes: the system refuses the write, as a full disk does.

    JAX keeps no programs meanwhile: it would keep their beginnings.
    """
    least = jax.config.jax_persistent_cache_min_compile_time_secs
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 1e9)
    before = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, limits[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
        signal.signal(signal.SIGXFSZ, before)
        jax.config.update("jax_persistent_cache_min_compile_time_secs", least)
