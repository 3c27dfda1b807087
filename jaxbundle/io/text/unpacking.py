"""Archives of arrays: the unpacked size above which files are refused before they fill the
memory, and the errors that a damaged one raises."""

import tokenize
import zipfile
import zlib

UNREADABLE_ARCHIVE = (
    OSError, EOFError, ValueError, LookupError, TypeError, AttributeError, ArithmeticError,
    RuntimeError, SyntaxError, MemoryError, tokenize.TokenError, zipfile.BadZipFile, zlib.error,
)  # fmt: skip
"""Errors of NumPy and zipfile for truncated, damaged or oversized archives: NumPy evaluates the
header of an array as Python text."""
RATIO, ALWAYS = 200, 2**20
"""Bytes unpacked for one packed: measured numbers give 2 to 5, repeated ones some tens, blanks a
thousand (gzip) or a million (bzip2). And bytes that are always harmless."""


def largest_unpacked_size(size: int) -> int:
    """The maximum unpacked size of a compressed file of this size, bytes."""
    return ALWAYS + RATIO * size
