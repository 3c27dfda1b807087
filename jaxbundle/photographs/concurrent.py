"""Memory for work on photographs: how many fit at once."""

from jaxbundle.system.cores import available_cores
from jaxbundle.system.memory import free_memory


def photographs_at_once(pixels: float, need: float, max_count: int | None = None) -> int:
    """How many photographs can be in work at once: at least one, at most one for each core.

    **Arguments:** `pixels` of the largest; `need`: bytes that the work takes, beside its grey
    values; `max_count`: instead of the number of cores.
    """
    # 64 MB: an arena, which glibc reserves for the allocations of a thread; 2.5 bytes a pixel while
    # a photograph is read, grey values and the compressed file (2.2 at 6 and 54 million pixels)
    bytes_each = 64e6 + 2.5 * pixels + need
    cores = available_cores() if max_count is None else max_count
    return max(1, int(min(cores, free_memory() / bytes_each)))
