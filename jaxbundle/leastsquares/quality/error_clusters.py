"""Observations in clusters: those that touch the same eliminated row, in arrays for batches.

Of `error_linearisation`, P = 1 − Q·Qᵀ has a block for every cluster. Clusters of as many rows are
laid out in one array, with the columns of A and of sparse roots that each of them has. Clusters
with the same columns are neighbours, so that products Xᵀ·Y of sparse matrices are sums of products
of tall dense ones (2·10⁹ operations in 0.04 s; a product of sparse matrices takes 8 s for these).
"""

import dataclasses
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from jaxbundle.leastsquares.quality.error_linearisation import LinearisedRows

Batch = Float[np.ndarray, "m k c"]
Places = Int[np.ndarray, "m c"]


@dataclasses.dataclass(frozen=True)
class Clusters:
    """m clusters of k rows each: `rows` of the observations, the eliminated row (−1: none of these
    clusters has one), Q, the values of A and of narrow roots F in the columns `A_at` and `F_at`
    (the number of columns stands for none), and V of a component of many columns. Rows of one
    cluster are sorted by `segment`, the range of columns of wide roots that they have; clusters of
    equal columns and segments begin at `groups`."""

    rows: Int[np.ndarray, "m k"]
    eliminated: Int[np.ndarray, " m"]
    Q: Batch
    A: Batch
    A_at: Places
    F: Batch
    F_at: Places
    V: Float[np.ndarray, "m k k"] | None
    segment: Int[np.ndarray, "m k"]
    groups: Int[np.ndarray, " groups"]

    def without_fit(self, x: Batch) -> Batch:
        """P·x."""
        return x - self.Q @ (self.Q.transpose(0, 2, 1) @ x)

    def spread(self, values: Batch, columns: Places, number: int) -> Batch:
        """Values in all of a number of columns from those in the columns `columns`; others are left
        out."""
        dense = np.zeros((*self.rows.shape, number + 1))
        cluster, row = (np.arange(n) for n in self.rows.shape)
        columns = np.where((columns < 0) | (columns > number), number, columns)
        dense[cluster[:, None, None], row[:, None], columns[:, None]] = values
        return dense[:, :, :number]

    def some(self, at: Any) -> "Clusters":
        """Some of the clusters."""
        fields = self.rows, self.eliminated, self.Q, self.A, self.A_at, self.F, self.F_at
        rows, eliminated, Q, A, A_at, F, F_at = (x[at] for x in fields)
        V, segment = None if self.V is None else self.V[at], self.segment[at]
        groups = _begin_groups([segment, A_at, F_at])
        return Clusters(rows, eliminated, Q, A, A_at, F, F_at, V, segment, groups)

    def portions(self, columns: int, at_once: int = 1_000_000) -> Iterator["Clusters"]:
        """Some clusters at a time, whose rows of so many columns have at most `at_once` numbers (8
        MB: four times as many take the same time, but memory that has to be cleared first)."""
        m, k = self.rows.shape
        step = max(at_once // max(k * columns, 1), 1)
        for begin in range(0, m, step):
            yield self.some(slice(begin, begin + step))

    def by_segments(self, columns: int) -> Iterator[tuple["Clusters", list[tuple[int, slice]]]]:
        """Some clusters at a time (`portions`), whose rows have the same segments; these, with the
        rows that have them."""
        for portion in self.portions(columns):
            begins = _begin_groups([portion.segment])
            for begin, end in zip(begins, [*begins[1:], len(portion.rows)]):
                of_row = portion.segment[begin]
                starts = np.flatnonzero(np.diff(of_row, prepend=-2))
                ranges = zip(starts, [*starts[1:], len(of_row)])
                segments = [(int(of_row[a]), slice(a, b)) for a, b in ranges if of_row[a] >= 0]
                whole = len(begins) == 1
                yield portion if whole else portion.some(slice(begin, end)), segments

    def by_columns(self) -> Iterator[slice]:
        """Clusters of equal columns."""
        for begin, end in zip(self.groups, [*self.groups[1:], len(self.rows)]):
            yield slice(begin, end)


def lay_out_clusters(
    linear: LinearisedRows, F: Any, segment: Int[np.ndarray, " rows"], many: Any | None
) -> list[Clusters] | None:
    """The clusters of all rows with a derivative or an error, by their number of rows, from sparse
    roots: of narrow ones, and of the component of many columns; None if a column of this has rows
    of different clusters. `segment` of wide roots."""
    cluster = linear.eliminated.copy()
    is_alone = cluster < 0
    # A row without an eliminated row is a cluster of its own: P is 1 there.
    cluster[is_alone] = cluster.max(initial=-1) + 1 + np.arange(is_alone.sum())
    # Rows without weight have neither.
    some = (np.diff(linear.A.indptr) + np.diff(F.indptr) > 0) | (linear.Q != 0).any(1)
    if many is not None:
        of_column = np.zeros(many.shape[1], int)
        row = np.repeat(cluster, np.diff(many.indptr))
        # The last row of a column wins; a column whose other rows differ from it joins clusters.
        of_column[many.indices] = row
        if (of_column[many.indices] != row).any():
            return None
        some |= np.diff(many.indptr) > 0
    order = np.flatnonzero(some)
    order = order[np.lexsort((segment[order], cluster[order]))]
    _, start, count = np.unique(cluster[order], return_index=True, return_counts=True)
    roots = [linear.A, F] if many is None else [linear.A, F, many]
    padded = [_padded(matrix) for matrix in roots]
    # Sorted by a random number of their columns, clusters of equal ones are neighbours: points of
    # the same photographs, whose sums are one product.
    rng = np.random.default_rng(0)
    of_columns = [rng.integers(1, 1 << 40, absent + 1) for *_, absent in padded[:2]]
    of_segment = rng.integers(1, 1 << 40, segment.max(initial=-1) + 2)
    key = np.zeros(len(cluster), int)
    for number, (columns, *_) in zip(of_columns, padded):
        key += number[columns].sum(1)
    # Batches of equal numbers of rows: padding to the longest track would square its length.
    kinds = np.stack([count, is_alone[order[start]]], 1)

    def lay_out(kind: Int[np.ndarray, "2"]) -> Clusters:
        rows = order[start[(kinds == kind).all(1)][:, None] + np.arange(kind[0])]
        # First by segments: clusters with the same ones are products of the same columns.
        rows = rows[np.lexsort((key[rows].sum(1), of_segment[segment[rows]].sum(1)))]
        (A, A_at), (narrow, narrow_at) = (
            _local(columns[rows], x[rows], absent) for columns, x, absent in padded[:2]
        )
        V = None
        for columns, x, absent in padded[2:]:
            V = _products(columns[rows], x[rows], absent)
        fields = rows, linear.eliminated[rows[:, 0]], linear.Q[rows], A, A_at, narrow, narrow_at
        of_rows = segment[rows]
        return Clusters(*fields, V, of_rows, _begin_groups([of_rows, A_at, narrow_at]))

    return [lay_out(kind) for kind in np.unique(kinds, axis=0)]


def _begin_groups(places: Sequence[Places]) -> Int[np.ndarray, " groups"]:
    """Where clusters of equal columns begin."""
    new = np.zeros(len(places[0]), bool)
    new[:1] = True
    for columns in places:
        new[1:] |= (columns[1:] != columns[:-1]).any(1)
    return np.flatnonzero(new)


def _padded(
    matrix: Any,
) -> tuple[Int[np.ndarray, "rows s"], Float[np.ndarray, "rows s"], int]:
    """Columns and values of every row of a sparse matrix, up to the largest number of them, and the
    column that stands for none."""
    absent, count = matrix.shape[1], np.diff(matrix.indptr)
    shape = len(count), int(count.max(initial=0))
    columns, values = np.full(shape, absent, np.int32), np.zeros(shape)
    is_filled = np.arange(shape[1]) < count[:, None]
    columns[is_filled], values[is_filled] = matrix.indices, matrix.data
    return columns, values, absent


def _local(
    columns: Int[np.ndarray, "m k s"], values: Float[np.ndarray, "m k s"], absent: int
) -> tuple[Batch, Places]:
    """The values of k rows in the distinct columns that any of them has, and these."""
    m, k, s = columns.shape
    if m * k * s == 0:
        return np.zeros((m, k, 0)), np.zeros((m, 0), int)
    # Columns are sorted once for all neighbours that have the same in every row.
    new = np.ones(m, bool)
    new[1:] = (columns[1:] != columns[:-1]).any((1, 2))
    run = np.cumsum(new) - 1
    flat = columns[new].reshape(-1, k * s)
    order = np.argsort(flat, 1)
    ordered = np.take_along_axis(flat, order, 1)
    slot = np.zeros(flat.shape, int)
    slot[:, 1:] = np.cumsum(ordered[:, 1:] != ordered[:, :-1], 1)
    places = np.full((len(flat), int(slot.max()) + 1), absent)
    np.put_along_axis(places, slot, ordered, 1)
    slot_of = np.empty_like(slot)
    np.put_along_axis(slot_of, order, slot, 1)
    dense = np.zeros((m, k, places.shape[1]))
    cluster, row = np.arange(m)[:, None, None], np.arange(k)[None, :, None]
    dense[cluster, row, slot_of.reshape(-1, k, s)[run]] = values
    return dense, places[run]


def _products(
    columns: Int[np.ndarray, "m k s"], values: Float[np.ndarray, "m k s"], absent: int
) -> Float[np.ndarray, "m k k"]:
    """G·Gᵀ of sparse rows G of every cluster."""
    # Columns differ from cluster to cluster, but hardly so if counted from their first.
    relative = np.where(
        columns == absent, absent, columns - columns.min((1, 2), initial=absent)[:, None, None]
    )
    G, _ = _local(relative, values, absent)
    return G @ G.transpose(0, 2, 1)
