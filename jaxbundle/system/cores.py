"""The cores of this machine, and the threads of XLA, which wait for each other in old versions."""

import os

from jaxbundle.system.xla_flags import jaxlib_version

# XLA's environment variable of the number of threads of its pool; default: one for each core.
THREADS = "NPROC"


def allow_programs_at_once() -> None:
    """Let programs with batched factorisations run at once, from several threads; call it before
    the first JAX computation.

    jaxlib 0.10 waits in XLA's pool for the parts of such a factorisation: as many programs as the
    pool has threads deadlock. From 0.11 on they do not (tests/test_float64.py, with one thread
    too), and nothing is set: more threads than cores make large networks up to a sixth slower
    (`NPROC=4 python benchmarks/bal_ours.py FILE --devices 2`).
    """
    if jaxlib_version() < (0, 11):
        os.environ.setdefault(THREADS, str(available_cores() + 2))


def can_run_two_programs() -> bool:
    """Whether XLA's pool has a thread left while two programs wait in it."""
    if jaxlib_version() >= (0, 11):
        return True  # they do not wait there
    threads = os.environ.get(THREADS, "")
    return (int(threads) if threads.isdecimal() else available_cores()) > 2


def use_cores(number: int | None = None) -> None:
    """Use all cores of the processor, or this number, for large networks, as JAX devices; call it
    before the first JAX computation."""
    import jax

    from jaxbundle.arguments import integer

    cores = available_cores() if number is None else integer("number", number)
    jax.config.update("jax_num_cpu_devices", cores)


def available_cores() -> int:
    """Cores this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1
