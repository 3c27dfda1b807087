"""Archives of arrays: the unpacked size above which files are refused before they fill the
memory, and the errors that a damaged one raises."""

import tokenize
import zipfile
import zlib

UNREADABLE_ARCHIVE = (
    *(OSError, EOFError, ValueError, LookupError, TypeError, AttributeError, ArithmeticError),
    *(RuntimeError, SyntaxError, MemoryError),
    *(tokenize.TokenError, zipfile.BadZipFile, zlib.error),
)
"""Errors of NumPy and zipfile for truncated, damaged or oversized archives: NumPy evaluates the
header of an array as Python text."""


def largest_unpacked_size(size: int, ratio: int = 200, harmless: int = 2**20) -> int:
    """The maximum unpacked size of a compressed file of this size, bytes.

    **Arguments:** `ratio`: bytes unpacked for one packed: measured numbers give 2 to 5, repeated
    ones some tens, blanks a thousand (gzip) or a million (bzip2); `harmless`: bytes that are always
    allowed.
    """
    return harmless + ratio * size
