"""The limit of unpacked size: larger files are refused before they fill the memory."""

RATIO, ALWAYS = 200, 2**20
"""Bytes unpacked for one packed: measured numbers give 2 to 5, repeated ones some tens, blanks a
thousand (gzip) or a million (bzip2). And bytes that are always harmless."""


def largest_unpacked_size(size: int) -> int:
    """The maximum unpacked size of a compressed file of this size, bytes."""
    return ALWAYS + RATIO * size
