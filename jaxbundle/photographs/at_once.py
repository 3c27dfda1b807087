"""Memory for work on photographs: how many fit at once."""

from jaxbundle.system.configuration import available_cores
from jaxbundle.system.memory import free_memory

OF_A_THREAD = 64e6
"""Bytes that the C library reserves for the allocations of a thread."""
OF_A_FILE = 2.5
"""Bytes a pixel while a photograph is read: grey values, and the compressed file (2.2 measured at 6
and 54 million pixels)."""


def photographs_at_once(pixels: float, need: float, most: int | None = None) -> int:
    """How many photographs can be in work at once: at least one, at most one for each core.

    **Arguments:** `pixels` of the largest; `need`: bytes that the work takes, beside its grey
    values; `most`: instead of the number of cores.
    """
    each = OF_A_THREAD + OF_A_FILE * pixels + need
    cores = available_cores() if most is None else most
    return max(1, int(min(cores, free_memory() / each)))
