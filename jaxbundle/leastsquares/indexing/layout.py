"""Observations in chunks that touch the same rows; pairs in chunks of the same block."""

from collections.abc import Hashable, Sequence

import numpy as np
from jaxtyping import Bool, Int

from jaxbundle.leastsquares.indexing.indices import as_index
from jaxbundle.leastsquares.indexing.plan import IncidencePairs, Key
from jaxbundle.leastsquares.indexing.settings import PlanningSettings


def chunk_length(major: Int[np.ndarray, " n"], settings: PlanningSettings) -> int:
    """The longest chunks of rows of one major with little padding; 1 for few rows."""
    if len(major) < settings.small_part:
        return 1
    _, number = np.unique(major, return_counts=True)
    fits = (
        length
        for length in settings.chunk_lengths
        if (-(-number // length) * length).sum() <= (1 + settings.max_padding) * len(major)
    )
    return next(fits, 1)


def lay_out(
    major: Int[np.ndarray, " n"], minor: Int[np.ndarray, " n"], length: int
) -> tuple[Int[np.ndarray, " n"], Bool[np.ndarray, " n"]]:
    """Rows sorted by (major, minor) in chunks of one major: the row at every position (a short
    chunk repeats its last), and whether the position is used."""
    # Within a major the minor ascends: eliminated rows are then read forwards in memory.
    order = np.lexsort((minor, major))
    if not len(order):
        return order, np.zeros(0, bool)
    _, first, number = np.unique(major[order], return_index=True, return_counts=True)
    room = -(-number // length) * length
    within = np.arange(room.sum()) - np.repeat(np.cumsum(room) - room, room)
    # Unused positions repeat a row that exists: what is computed there is finite, and weighted 0.
    last_place = np.repeat(number, room) - 1
    return order[np.repeat(first, room) + np.minimum(within, last_place)], within <= last_place


def pairs_between(
    a: Int[np.ndarray, " n"], b: Int[np.ndarray, " m"]
) -> tuple[Int[np.ndarray, " n"], Int[np.ndarray, " n"]]:
    """All (i, j) with a[i] = b[j]."""
    order = np.argsort(b, kind="stable")
    start = np.searchsorted(b[order], a, "left")
    count = np.searchsorted(b[order], a, "right") - start
    i = np.repeat(np.arange(len(a)), count)
    within = np.arange(count.sum()) - np.repeat(np.cumsum(count) - count, count)
    return i, order[np.repeat(start, count) + within]


def pair_chunk_lengths(pairs: int, settings: PlanningSettings) -> tuple[int, ...]:
    """The chunk lengths for this number of pairs; none without pairs."""
    if not pairs:
        return ()
    is_few = pairs < settings.few_pairs
    return (settings.few_pairs_chunk_length,) if is_few else settings.pair_chunk_lengths


def chunk_pairs(
    i: Int[np.ndarray, " n"],
    j: Int[np.ndarray, " n"],
    block: Int[np.ndarray, " n"],
    into: Sequence[tuple[Hashable, int]],
    along: Hashable,
    key: Key,
    lengths: tuple[int, ...],
) -> IncidencePairs:
    """Pairs sorted by block, in chunks of one block, the longest first."""
    order = np.argsort(block, kind="stable")
    i, j = i[order], j[order]
    blocks, start, remaining = np.unique(block[order], return_index=True, return_counts=True)
    first, second, block_of_chunk = [], [], []
    # Blocks with many pairs take long chunks first, what is left shorter ones; the last is padded.
    for length in lengths:
        number = -(-remaining // length) if length == lengths[-1] else remaining // length
        chunk = np.repeat(np.arange(len(blocks)), number)
        within = np.arange(number.sum()) - np.repeat(np.cumsum(number) - number, number)
        pair = start[chunk][:, None] + within[:, None] * length + np.arange(length)
        valid = pair < (start + remaining)[chunk][:, None]
        pair = np.where(valid, pair, 0)
        # −1 at unused positions: the empty incidence, whose product is 0.
        size_key = ("pairs", *key, length)
        first.append(as_index(np.where(valid, i[pair], -1), size_key, *into[0]))
        second.append(as_index(np.where(valid, j[pair], -1), size_key, *into[1]))
        block_of_chunk.append(as_index(blocks[chunk], size_key, along))
        done = np.minimum(number * length, remaining)
        start, remaining = start + done, remaining - done
    return IncidencePairs(tuple(first), tuple(second), tuple(block_of_chunk))
