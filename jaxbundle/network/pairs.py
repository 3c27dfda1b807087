"""Lists of row pairs, grouped by the block of a matrix that their products add up to.

The reduced normal matrix of a network is a sum of small products AᵀB over pairs of rows: two rays
of one point (the block of their two images). `Pairs` lists
the pairs of each block in chunks of fixed lengths, so that a chunk is one small matrix product
of depth (chunk length × rows) and the whole sum a few batched products. Measured on a BAL block
of 16 images and 83 718 rays: a quarter of the time of outer products with scatter.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

CHUNK_LENGTHS = (256, 32, 4)
SMALL_CHUNK_LENGTHS = (8,)
"""For lists under `SMALL` pairs: one length compiles in a third of the time."""
SMALL = 50_000
ROWS_PER_STEP = 8192


class Pairs(eqx.Module):
    """Pairs (a, b) of rows and the blocks of a matrix they belong to.

    A missing partner in a chunk is a row of zeros: one past the last row, or the last row itself
    where that is known to be empty (`empty`: for the first and the second table).
    `row`, `column`: position of each block in the block matrix.
    """

    first: tuple[Int[Array, "chunks length"], ...]
    second: tuple[Int[Array, "chunks length"], ...]
    block: tuple[Int[Array, " chunks"], ...]
    row: Int[Array, " blocks"]
    column: Int[Array, " blocks"]
    empty: tuple[bool, bool] = eqx.field(static=True, default=(False, False))

    def sum(
        self, a: Float[Array, "rows d m"], b: Float[Array, "rows d n"]
    ) -> Float[Array, "blocks m n"]:
        """Σ aᵀb over the pairs of every block."""
        blocks = self.row.shape[0]
        same = a is b
        a = a if self.empty[0] else _with_zero_row(a)
        b = a if same else b if self.empty[1] else _with_zero_row(b)
        missing = a.shape[0] - 1, b.shape[0] - 1
        depth, m, n = a.shape[1], a.shape[2], b.shape[2]
        total = jnp.zeros((blocks + 1, m, n), a.dtype)
        for first, second, block in zip(self.first, self.second, self.block):

            def add(total, chunk, rows=first.shape[1] * depth):
                i, j, k = chunk
                left, right = a[i].reshape(-1, rows, m), b[j].reshape(-1, rows, n)
                product = jnp.einsum("cki,ckj->cij", left, right)
                return total.at[k].add(product, indices_are_sorted=True)

            total = _over_steps(add, total, (first, second, block), (*missing, blocks))
        return total[:-1]

    def spread(
        self,
        a: Float[Array, "rows d m"],
        b: Float[Array, "rows d n"],
        Q: Float[Array, "blocks m n"],
        totals: tuple[Float[Array, "rows d m"], Float[Array, "rows d n"]],
    ) -> tuple[Float[Array, "rows d m"], Float[Array, "rows d n"]]:
        """The other way round: to the first of the totals is added b·Qᵀ for every partner b of its
        row, to the second a·Q; Q is the block of each pair."""
        add = lambda totals, i, to_first, j, to_second: (
            totals[0].at[i].add(to_first), totals[1].at[j].add(to_second)
        )  # fmt: skip
        return self._spread(a, b, Q, Q, totals, add)

    def spread_within(
        self, a: Float[Array, "rows d m"], Q: Float[Array, "blocks m m"], total
    ) -> Float[Array, "rows d m"]:
        """The same where both tables are one. Pairs within a block are then listed in both orders,
        a row with itself once: they count one way only."""
        once = jnp.where((self.row == self.column)[:, None, None], 0.0, Q)
        add = lambda total, i, to_first, j, to_second: (
            total.at[i].add(to_first).at[j].add(to_second)
        )  # fmt: skip
        return self._spread(a, a, Q, once, total, add)

    def _spread(self, a, b, Q_first, Q_second, total, add):
        # Missing rows are past the end of the totals, where nothing is added.
        first_table = a if self.empty[0] else _with_zero_row(a)
        second_table = b if self.empty[1] else _with_zero_row(b)
        missing = (first_table.shape[0] - 1, second_table.shape[0] - 1, self.row.shape[0])

        def add_chunk(total, chunk):
            i, j, k = chunk
            to_first = jnp.einsum("cldn,cmn->cldm", second_table[j], Q_first[k])
            to_second = jnp.einsum("cldm,cmn->cldn", first_table[i], Q_second[k])
            return add(total, i, to_first, j, to_second)

        for chunks in zip(self.first, self.second, self.block):
            total = _over_steps(add_chunk, total, chunks, missing)
        return total


def _with_zero_row(a):
    return jnp.concatenate([a, jnp.zeros((1, *a.shape[1:]), a.dtype)])


def _over_steps(add, total, chunks, missing):
    """`add` all chunks to the total in portions; the last portion is filled with missing ones."""
    number, length = chunks[0].shape
    step = max(1, ROWS_PER_STEP // length)
    if number <= step:
        return add(total, chunks) if number else total
    fill = lambda x, value: jnp.concatenate(
        [x, jnp.full((-number % step, *x.shape[1:]), value, x.dtype)]
    ).reshape(-1, step, *x.shape[1:])
    portions = tuple(fill(x, value) for x, value in zip(chunks, missing))
    return jax.lax.scan(lambda total, chunk: (add(total, chunk), None), total, portions)[0]


def make_pairs(
    first, second, row, column, columns: int, missing: tuple[int, int], lengths=None,
    empty: tuple[bool, bool] = (False, False), blocks=None,
) -> Pairs:  # fmt: skip
    """Group pairs (first, second) by their block (row, column) of a matrix.

    **Arguments:** row indices `first`, `second` [pairs]; block indices `row`, `column` [pairs];
    `columns`: number of block columns; `missing`: the rows that stand for a missing partner, and
    whether they are the last ones of their tables (`empty`) or one past them;
    `lengths` of chunks, the longest first (None: by the number of pairs); `blocks`: rows and
    columns of all blocks, in order, if these pairs are only some of those of the network.
    """
    key = np.asarray(row, np.int64) * columns + np.asarray(column, np.int64)
    order = np.argsort(key, kind="stable")
    first, second = np.asarray(first)[order], np.asarray(second)[order]
    keys, start, left = np.unique(key[order], return_index=True, return_counts=True)
    if blocks is not None:
        whole = np.asarray(blocks[0], np.int64) * columns + np.asarray(blocks[1], np.int64)
        place = np.searchsorted(whole, keys)
        spread = lambda x: np.bincount(place, x, len(whole)).astype(np.int64)
        keys, start, left = whole, spread(start), spread(left)
    groups = []
    if lengths is None:
        lengths = SMALL_CHUNK_LENGTHS if len(key) < SMALL else CHUNK_LENGTHS
    for length in lengths:
        last = length == lengths[-1]
        chunks = -(-left // length) if last else left // length
        block = np.repeat(np.arange(len(keys)), chunks)
        within = np.arange(chunks.sum()) - np.repeat(np.cumsum(chunks) - chunks, chunks)
        index = start[block][:, None] + within[:, None] * length + np.arange(length)
        valid = index < (start + left)[block][:, None]
        index = np.where(valid, index, 0)
        groups.append((
            np.where(valid, first[index], missing[0]),
            np.where(valid, second[index], missing[1]),
            block,
        ))
        taken = np.minimum(chunks * length, left)
        start, left = start + taken, left - taken
    as_int = lambda x: np.asarray(x, np.int32)
    return Pairs(
        first=tuple(as_int(g[0]) for g in groups),
        second=tuple(as_int(g[1]) for g in groups),
        block=tuple(as_int(g[2]) for g in groups),
        row=as_int(keys // columns),
        column=as_int(keys % columns),
        empty=empty,
    )


def pairs_within(group: Int[np.ndarray, " rows"]):
    """All pairs (i < j) of rows of the same group; `group` is sorted. Two index arrays."""
    group = np.asarray(group)
    if not len(group):
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    _, start, size = np.unique(group, return_index=True, return_counts=True)
    first, second = [], []
    for count in np.unique(size):
        i, j = np.triu_indices(count, 1)
        base = start[size == count][:, None]
        first.append((base + i).ravel())
        second.append((base + j).ravel())
    return np.concatenate(first), np.concatenate(second)


def pairs_between(group_a, group_b):
    """All pairs (i, j) of rows with group_a[i] == group_b[j]; both are sorted."""
    group_a, group_b = np.asarray(group_a), np.asarray(group_b)
    start = np.searchsorted(group_b, group_a, side="left")
    count = np.searchsorted(group_b, group_a, side="right") - start
    first = np.repeat(np.arange(len(group_a)), count)
    within = np.arange(count.sum()) - np.repeat(np.cumsum(count) - count, count)
    return first, np.repeat(start, count) + within
