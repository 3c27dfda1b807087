"""How far a compressed file may unpack: what claims more is refused before it fills the memory."""

RATIO, ALWAYS = 200, 2**20
"""Bytes unpacked for one packed: measured numbers give 2 to 5, repeated ones some tens, blanks a
thousand (gzip) or a million (bzip2). And bytes that are no danger."""


def most_unpacked(size: int) -> int:
    """The most bytes that a compressed file of so many bytes may unpack to."""
    return ALWAYS + RATIO * size
