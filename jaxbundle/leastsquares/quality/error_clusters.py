"""Observations in clusters: those that touch the same eliminated row, in arrays for batches.

Of `error_linearisation`, P = 1 − Q·Qᵀ has a block for every cluster. Clusters of as many rows are
laid out in one array, with the columns of A and of sparse roots that each of them has. Clusters
with the same columns are neighbours, so that products Xᵀ·Y of sparse matrices are sums of products
of tall dense ones (2·10⁹ operations in 0.04 s; a product of sparse matrices takes 8 s for these).
"""

import dataclasses
import functools
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from jaxbundle.leastsquares.quality.error_linearisation import LinearisedRows

Batch = Float[np.ndarray, "m k c"]
Places = Int[np.ndarray, "m c"]


@dataclasses.dataclass(frozen=True)
class Clusters:
    """m clusters of k rows each: `rows` of the observations, of which those of one cluster are
    sorted by `segment`, the range of columns of wide roots that they have. `roots`: of narrow
    components, and of the one of many columns.

    Values are laid out when they are asked for, which is for some at a time: those of all clusters
    take more memory than all statistics."""

    rows: Int[np.ndarray, "m k"]
    linear: LinearisedRows
    roots: tuple[Any, Any | None]
    segment: Int[np.ndarray, " rows"]

    @property
    def has_eliminated(self) -> bool:
        """Whether these clusters have eliminated rows; all of them have, or none."""
        return bool(self.linear.eliminated[self.rows[0, 0]] >= 0)

    @property
    def eliminated(self) -> Int[np.ndarray, " m"]:
        """The eliminated row (−1: none of these clusters has one)."""
        return self.linear.eliminated[self.rows[:, 0]]

    @functools.cached_property
    def Q(self) -> Batch:
        return self.linear.Q[self.rows]

    @functools.cached_property
    def A(self) -> "ValuesAt":
        """The derivatives by kept unknowns."""
        return _local(*_padded(self.linear.A, self.rows))

    @functools.cached_property
    def F(self) -> "ValuesAt":
        """The narrow roots."""
        return _local(*_padded(self.roots[0], self.rows))

    @functools.cached_property
    def V(self) -> Float[np.ndarray, "m k k"] | None:
        """V of the component of many columns."""
        many = self.roots[1]
        return None if many is None else _products(*_padded(many, self.rows))

    def without_fit(self, x: Batch) -> Batch:
        """P·x."""
        return x - self.Q @ (self.Q.transpose(0, 2, 1) @ x)

    def some(self, at: Any) -> "Clusters":
        """Some of the clusters."""
        return dataclasses.replace(self, rows=self.rows[at])

    def portions(self, columns: int, at_once: int = 1_000_000) -> Iterator["Clusters"]:
        """Some clusters at a time, whose rows of their own and so many more columns have about
        `at_once` numbers (8 MB: four times as many take the same time, but memory that has to be
        cleared first)."""
        m, k = self.rows.shape
        # Of clusters of as many rows, about as many columns as the first one has.
        own_columns = [np.unique(x[self.rows[0]].indices) for x in (self.linear.A, self.roots[0])]
        step = max(at_once // max(k * (sum(map(len, own_columns)) + columns), 1), 1)
        for begin in range(0, m, step):
            yield self.some(slice(begin, begin + step))

    def by_segments(self, columns: int) -> Iterator[tuple["Clusters", list[tuple[int, slice]]]]:
        """Some clusters at a time (`portions`), whose rows have the same segments; these, with the
        rows that have them."""
        for portion in self.portions(columns):
            of_rows = self.segment[portion.rows]
            for equal in equal_neighbours(of_rows):
                segment = of_rows[equal.start]
                starts = np.flatnonzero(np.diff(segment, prepend=-2))
                ranges = zip(starts, [*starts[1:], len(segment)])
                segments = [(int(segment[a]), slice(a, b)) for a, b in ranges if segment[a] >= 0]
                yield portion.some(equal), segments


class ValuesAt(NamedTuple):
    """Values of rows of clusters in the columns `at` (the number of columns stands for none)."""

    values: Batch
    at: Places

    def spread(self, number: int, first: int = 0) -> Batch:
        """The values in a number of columns from `first` on; others are left out."""
        m, k, _ = self.values.shape
        dense = np.zeros((m, k, number + 1))
        columns = self.at - first
        columns = np.where((columns < 0) | (columns > number), number, columns)
        cluster, row = np.arange(m)[:, None, None], np.arange(k)[:, None]
        dense[cluster, row, columns[:, None]] = self.values
        return dense[:, :, :number]


def equal_neighbours(*places: Places) -> Iterator[slice]:
    """Clusters of equal columns."""
    new = np.zeros(len(places[0]), bool)
    new[:1] = True
    for columns in places:
        new[1:] |= (columns[1:] != columns[:-1]).any(1)
    begins = np.flatnonzero(new)
    for begin, end in zip(begins, [*begins[1:], len(new)]):
        yield slice(begin, end)


def find_clusters(
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
    # Sorted by a random number of their columns, clusters of equal ones are neighbours: points of
    # the same photographs, whose sums are one product.
    rng = np.random.default_rng(0)
    random_number = lambda number: rng.integers(1, 1 << 40, number)
    key = np.zeros(len(cluster), int)
    for matrix in (linear.A, F):
        # of the entries that are stored, whatever their values
        ones = np.ones(len(matrix.indices), int)
        key += type(matrix)((ones, matrix.indices, matrix.indptr), matrix.shape) @ random_number(
            matrix.shape[1]
        )
    of_segment = random_number(segment.max(initial=-1) + 2)
    # Batches of equal numbers of rows: padding to the longest track would square its length.
    kinds = np.stack([count, is_alone[order[start]]], 1)

    def of_kind(kind: Int[np.ndarray, "2"]) -> Clusters:
        rows = order[start[(kinds == kind).all(1)][:, None] + np.arange(kind[0])]
        # First by segments: clusters with the same ones are products of the same columns.
        rows = rows[np.lexsort((key[rows].sum(1), of_segment[segment[rows]].sum(1)))]
        return Clusters(rows, linear, (F, many), segment)

    return [of_kind(kind) for kind in np.unique(kinds, axis=0)]


def _padded(
    matrix: Any, rows: Int[np.ndarray, "m k"]
) -> tuple[Int[np.ndarray, "m k s"], Float[np.ndarray, "m k s"], int]:
    """Columns and values of some rows of a sparse matrix, up to the largest number of them, and the
    column that stands for none."""
    begin, count = matrix.indptr[rows][..., None], np.diff(matrix.indptr)[rows][..., None]
    place = np.arange(count.max(initial=0))
    is_filled, at = place < count, np.minimum(begin + place, max(matrix.nnz - 1, 0))
    absent = matrix.shape[1]
    if not matrix.nnz:
        return np.full(at.shape, absent, np.int32), np.zeros(at.shape), absent
    columns = np.where(is_filled, matrix.indices[at], absent)
    return columns, np.where(is_filled, matrix.data[at], 0.0), absent


def _local(
    columns: Int[np.ndarray, "m k s"], values: Float[np.ndarray, "m k s"], absent: int
) -> ValuesAt:
    """The values of k rows in the distinct columns that any of them has, and these."""
    m, k, s = columns.shape
    if m * k * s == 0:
        return ValuesAt(np.zeros((m, k, 0)), np.zeros((m, 0), int))
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
    return ValuesAt(dense, places[run])


def _products(
    columns: Int[np.ndarray, "m k s"], values: Float[np.ndarray, "m k s"], absent: int
) -> Float[np.ndarray, "m k k"]:
    """G·Gᵀ of sparse rows G of every cluster."""
    # Columns differ from cluster to cluster, but hardly so if counted from their first.
    relative = np.where(
        columns == absent, absent, columns - columns.min((1, 2), initial=absent)[:, None, None]
    )
    G = _local(relative, values, absent).values
    return G @ G.transpose(0, 2, 1)
