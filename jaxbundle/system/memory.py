"""Memory that the C library keeps."""

import ctypes
import sys


def return_freed_memory() -> None:
    """Return freed memory to the system (glibc). Reading and planning a large problem leave it in
    small pieces, which the arrays of XLA cannot use: 40 MB before the first iteration on 84 000
    image points."""
    if sys.platform == "linux":
        trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
        if trim is not None:
            trim(0)
