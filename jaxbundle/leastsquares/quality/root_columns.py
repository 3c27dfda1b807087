"""The roots of error components, by what they are: of few columns or of many, with few values in a
row or with many.

V = F·Fᵀ of a component has a sparse root F. Those of few columns, which cameras and photographs
have, are further unknowns of the reduced system; the one of many columns has a block for every
cluster (`error_products`).
"""

from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from jaxbundle.leastsquares.quality.error_clusters import Batch

Matrix = Float[np.ndarray, "n m"]


class ColumnSegments(NamedTuple):
    """Ranges of columns of a sparse matrix that none of its rows crosses: where they begin, with
    the number of all columns behind; by row its segment (−1: the row is empty); the matrix with the
    columns of every row counted from the first of its segment."""

    begin: Int[np.ndarray, " segments+1"]
    of_row: Int[np.ndarray, " rows"]
    within: Any

    @property
    def number(self) -> int:
        return len(self.begin) - 1

    def rows(self, rows: Int[np.ndarray, "m k"]) -> Batch:
        """Some rows, in the columns of their segments."""
        return self.within[rows.ravel()].toarray().reshape(*rows.shape, self.within.shape[1])

    def joined(self, parts: Float[np.ndarray, "segments *n width"]) -> Float[np.ndarray, "*n all"]:
        """Quantities by the columns of each segment as those of all columns."""
        width = np.diff(self.begin)
        return np.concatenate([x[..., :w] for x, w in zip(parts, width)], -1)


class RootColumns(NamedTuple):
    """The roots of few columns in two sparse matrices: `narrow` with few values in a row, as of
    photographs, and `wide`; `segments`: the columns of wide ones fall into ranges that no row
    crosses, as those of x and of y of a camera; `mixing`: by the columns of wide ones of every
    component the matrix that mixes every as many of them as it has rows (None: as they are).
    `many`: the sparse root of the component of many columns, None if there is none.
    `of_components`: the columns of every other component, mixed, the narrow ones first."""

    narrow: Any
    wide: Any
    segments: ColumnSegments
    mixing: list[tuple[slice, Matrix | None]]
    many: Any | None
    of_components: list[slice | None]

    @property
    def number(self) -> int:
        """Mixed columns of few."""
        return max((s.stop for s in self.of_components if s is not None), default=0)

    def mix(self, x: Float[np.ndarray, "*n columns"]) -> Float[np.ndarray, "*n mixed"]:
        """Quantities by the columns of wide roots as those of mixed ones."""
        parts = [x[..., :0]]
        for columns, mixing in self.mixing:
            part = x[..., columns]
            if mixing is not None:
                b, c = mixing.shape
                shape, blocks = part.shape[:-1], part.shape[-1] // b
                rows = int(np.prod(shape)) * blocks
                part = (part.reshape(rows, b) @ mixing).reshape(*shape, blocks * c)
            parts.append(part)
        return np.concatenate(parts, -1)

    def wide_rows(self, rows: Int[np.ndarray, "m k"]) -> Batch:
        """The wide roots of some rows, not mixed."""
        return self.wide[rows.ravel()].toarray().reshape(*rows.shape, self.wide.shape[1])


def sort_roots(
    roots: Sequence[tuple[Any, Matrix | None]], max_columns: int, max_narrow: int = 8
) -> RootColumns | None:
    """Roots by what they are; None if several have many columns. `max_narrow`: values in a row of
    a sparse one; a spline of the sensor has 16, and with several image points of a track nearly
    all."""
    import scipy.sparse as sp

    many = [k for k, (root, _) in enumerate(roots) if root.shape[1] > max_columns]
    if not roots or len(many) > 1:
        return None
    of_components: list[slice | None] = [None] * len(roots)
    dense = lambda root: root.nnz > max_narrow * np.count_nonzero(np.diff(root.indptr))
    few = [k for k in range(len(roots)) if k not in many]
    # Narrow ones first: they are laid out by clusters, wide ones read from their sparse matrix.
    few.sort(key=lambda k: dense(roots[k][0]))
    empty = sp.csr_matrix((roots[0][0].shape[0], 0))
    narrow, wide, mixed, begin = [empty], [empty], [], 0
    for k in few:
        root, mixing = roots[k]
        number = root.shape[1]
        if dense(root):
            columns_before = sum(x.shape[1] for x in wide)
            mixed.append((slice(columns_before, columns_before + number), mixing))
            wide.append(root)
        else:
            narrow.append(root if mixing is None else root @ _repeat(mixing, number))
        if mixing is not None:
            number = number // len(mixing) * mixing.shape[1]
        of_components[k] = slice(begin, begin + number)
        begin += number
    of_many = None
    for k in many:
        root, mixing = roots[k]
        of_many = root if mixing is None else root @ _repeat(mixing, root.shape[1])
    joined = lambda x: sp.hstack(x).tocsr() if len(x) > 2 else x[-1]
    all_wide = joined(wide)
    return RootColumns(
        joined(narrow), all_wide, segments_of(all_wide), mixed, of_many, of_components
    )


def _repeat(mixing: Matrix, columns: int) -> Any:
    """The sparse matrix that mixes all columns."""
    import scipy.sparse as sp

    return sp.kron(sp.identity(columns // len(mixing)), sp.csr_matrix(mixing)).tocsr()


def segments_of(F: Any) -> ColumnSegments:
    """The segments of a sparse matrix."""
    import scipy.sparse as sp

    count = np.diff(F.indptr)
    of_row, some = np.full(F.shape[0], -1), np.flatnonzero(count)
    begin, first = np.zeros(1, int), np.zeros(0, int)
    if len(some):
        first = np.minimum.reduceat(F.indices, F.indptr[some])
        last = np.maximum.reduceat(F.indices, F.indptr[some])
        # Rows that reach from before a column to it or beyond; columns of no row join others.
        crossing = np.bincount(first + 1, minlength=F.shape[1] + 2).cumsum()
        crossing -= np.bincount(last + 1, minlength=F.shape[1] + 2).cumsum()
        begin = np.flatnonzero(crossing[: F.shape[1]] == 0)
        of_row[some] = np.searchsorted(begin, first, side="right") - 1
    begin = np.append(begin, F.shape[1])
    width = int(np.diff(begin).max(initial=0))
    indices = F.indices - np.repeat(begin[of_row], count).astype(F.indices.dtype)
    within = sp.csr_matrix((F.data, indices, F.indptr), (F.shape[0], width))
    return ColumnSegments(begin, of_row, within)


def rows_of_equal_columns(
    F: Any,
) -> Iterator[tuple[Int[np.ndarray, " n"], Int[np.ndarray, " c"], Matrix]]:
    """The rows of a sparse matrix with values in the same columns: these rows, the columns, and the
    values."""
    count = np.diff(F.indptr)
    rows = np.flatnonzero(count)
    # Rows with values in the same columns have equal sums of the columns' random numbers; that
    # others have the same sum has a probability of 2⁻⁴⁰ a pair. They list their columns in the same
    # order, which is that of the first one below.
    key = np.random.default_rng(0).integers(1, 1 << 40, F.shape[1])[F.indices]
    pattern = np.add.reduceat(key, F.indptr[rows]) if len(rows) else rows
    order = np.argsort(pattern, kind="stable")
    begins, rows = np.flatnonzero(np.diff(pattern[order], prepend=-1)), rows[order]
    for a, b in zip(begins, [*begins[1:], len(rows)]):
        start, number = F.indptr[rows[a:b]], count[rows[a]]
        columns = F.indices[start[0] : start[0] + number]
        yield rows[a:b], columns, F.data[start[:, None] + np.arange(number)]


def gram(F: Any) -> Matrix:
    """FᵀF of a sparse matrix, by dense products of the rows with values in the same columns."""
    product = np.zeros((F.shape[1],) * 2)
    for _, columns, x in rows_of_equal_columns(F):
        product[columns[:, None], columns] += x.T @ x
    return product
