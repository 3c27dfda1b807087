"""Sums over clusters of observations (`error_clusters`) that products of error components with M
are made of (`error_products`).

With P = 1 − Q·Qᵀ a product XᵀPY is XᵀY, of rows with values in the same columns at a time, less
(QᵀX)ᵀ·QᵀY, which has three rows for a point instead of two for each of its rays. A product with V
of a component of many columns between, XᵀPVPY, needs all of them: it is formed exactly for unknowns
and roots of few values in a row. For the others V is replaced by its mean, f, and the difference is
from some of the clusters,

    XᵀPVPY = f·XᵀPY + XᵀP(V − f)PY
"""

import dataclasses
from collections.abc import Iterable, Iterator, Sequence

import numpy as np
from jaxtyping import Bool, Float

from jaxbundle.leastsquares.quality.error_clusters import Batch, Clusters, equal_neighbours
from jaxbundle.leastsquares.quality.error_linearisation import DatumDirections, LinearisedRows
from jaxbundle.leastsquares.quality.root_columns import (
    Matrix,
    RootColumns,
    gram,
    rows_of_equal_columns,
)
from jaxbundle.types import not_none


@dataclasses.dataclass
class ClusterSums:
    """AᵀPA, AᵀPF, FᵀPF of kept unknowns A and roots F; of the directions h = E·V⁻¹·B_e of the datum
    hᵀA and hᵀF; with V between, AᵀPVPA, AᵀPVPVPA, AᵀPVh, hᵀVh, and of narrow roots AᵀPVPF and the
    diagonal of FᵀPVPF; `powers`: tr((P·V)ⁿ) of n = 1 … 4; `mean_of_V`: the mean of its diagonal."""

    AA: Matrix
    AF: Matrix
    FF: Matrix
    hA: Matrix
    hF: Matrix
    AVA: Matrix
    AVPVA: Matrix
    AVh: Matrix
    hVh: Matrix
    AVF: Matrix
    FVF: Float[np.ndarray, " narrow"]
    powers: Float[np.ndarray, "4"]
    mean_of_V: float


def sum_products(
    clusters: Sequence[Clusters],
    linear: LinearisedRows,
    roots: RootColumns,
    datum: DatumDirections,
) -> ClusterSums:
    """The sums over all clusters."""
    (with_narrow, with_wide), wide = _without_clusters(linear, roots), gram(roots.wide)
    total = _Sums(roots, linear.A.shape[1], datum)
    for c in clusters:
        total.add(c.by_segments(roots.wide.shape[1]))
    with_narrow -= total.with_narrow
    with_wide -= total.with_wide
    wide -= total.wide
    of_wide, p, n = roots.segments, linear.A.shape[1], roots.narrow.shape[1]
    kept, narrow = slice(0, p), slice(p + 1, p + 1 + n)
    mixed, hX = roots.mix(of_wide.joined(with_wide)), total.hX
    wide = roots.mix(roots.mix(wide).T)
    return ClusterSums(
        with_narrow[kept, kept],
        np.concatenate([with_narrow[kept, narrow], mixed[kept]], 1),
        np.block([[with_narrow[narrow, narrow], mixed[narrow]], [mixed[narrow].T, wide]]),
        hX[:, kept],
        np.concatenate([hX[:, narrow], roots.mix(of_wide.joined(total.hW))], 1),
        total.AVX[kept, kept],
        total.AVPVA[kept, kept],
        total.AVh[kept],
        total.hVh,
        total.AVX[kept, narrow],
        total.FVF[:n],
        total.powers,
        total.diagonal / max(total.rows, 1),
    )


class _Sums:
    """Sums over some clusters, in which the place behind the last of A and of narrow F stands for
    none: clusters have as many places as the largest of their batch needs."""

    def __init__(self, roots: RootColumns, unknowns: int, datum: DatumDirections):
        self.of_wide, self.datum, self.of_narrow = roots.segments, datum, unknowns + 1
        p, places, d = unknowns + 1, unknowns + 1 + roots.narrow.shape[1] + 1, datum.number
        s, width = self.of_wide.number, self.of_wide.within.shape[1]
        self.with_narrow = np.zeros((places, places))
        self.with_wide = np.zeros((s, places, width))
        self.wide = np.zeros((roots.wide.shape[1],) * 2)
        self.hX, self.hW = np.zeros((d, places)), np.zeros((s, d, width))
        self.AVX, self.AVPVA = np.zeros((p, places)), np.zeros((p, p))
        self.FVF = np.zeros(places - p)
        self.AVh, self.hVh = np.zeros((p, d)), np.zeros((d, d))
        self.powers, self.diagonal, self.rows = np.zeros(4), 0.0, 0

    def add(self, portions: Iterable[tuple[Clusters, list[tuple[int, slice]]]]) -> None:
        """Add clusters whose rows have the same segments, given with them."""
        for c, segments in portions:
            if c.V is not None:
                self._add_with_V(c, c.V)
            if c.has_eliminated:
                self._add_fit(c, segments)

    def _add_fit(self, c: Clusters, segments: Sequence[tuple[int, slice]]) -> None:
        """Add (QᵀX)ᵀ·QᵀX of all roots and unknowns, and hᵀX."""
        turned, W = c.Q.transpose(0, 2, 1), self.of_wide.rows(c.rows)
        X, h = (
            turned @ np.concatenate([c.A.values, c.F.values], 2),
            self.datum.of_eliminated[c.eliminated],
        )
        by_segment = [turned[:, :, rows] @ W[:, rows] for _, rows in segments]
        Y = np.concatenate([X[:, :, :0], *by_segment], 2)
        at, width = np.concatenate([c.A.at, self.of_narrow + c.F.at], 1), W.shape[2]
        # Clusters of the same photographs add to the same places: one product for all of them.
        for some in equal_neighbours(at):
            places, x = at[some.start], tall(X[some])
            self.with_narrow[places[:, None], places] += x.T @ x
            self.hX[:, places] += tall(h[some]).T @ x
            product = x.T @ tall(Y[some])
            for k, (segment, _) in enumerate(segments):
                self.with_wide[segment, places] += product[:, k * width : (k + 1) * width]
        y, begin = tall(Y), self.of_wide.begin
        product = y.T @ y
        for k, (segment, _) in enumerate(segments):
            self.hW[segment] += tall(h).T @ y[:, k * width : (k + 1) * width]
            rows, number = slice(begin[segment], begin[segment + 1]), np.diff(begin)[segment]
            for l, (other, _) in enumerate(segments):
                columns, n = slice(begin[other], begin[other + 1]), np.diff(begin)[other]
                self.wide[rows, columns] += product[k * width :, l * width :][:number, :n]

    def _add_with_V(self, c: Clusters, V: Batch) -> None:
        """Add what has V between."""
        A, F = c.without_fit(c.A.values), c.without_fit(c.F.values)
        h = self.datum.effects(c.Q, c.eliminated)
        VA, Vh = V @ A, V @ h
        PVA = c.without_fit(VA)
        self.hVh += tall(h).T @ tall(Vh)
        self.FVF += np.bincount(c.F.at.ravel(), np.sum(V @ F * F, 1).ravel(), len(self.FVF))
        for some in equal_neighbours(c.A.at, c.F.at):
            of_A, of_F = c.A.at[some.start], self.of_narrow + c.F.at[some.start]
            x, y, v = tall(A[some]), tall(PVA[some]), tall(VA[some])
            self.AVX[of_A[:, None], of_A] += v.T @ x
            self.AVX[of_A[:, None], of_F] += v.T @ tall(F[some])
            self.AVPVA[of_A[:, None], of_A] += y.T @ y
            self.AVh[of_A] += x.T @ tall(Vh[some])
        self.powers += _powers(c, V)
        self.diagonal += np.trace(V, axis1=1, axis2=2).sum()
        self.rows += c.rows.size


def _without_clusters(
    linear: LinearisedRows, roots: RootColumns
) -> tuple[Matrix, Float[np.ndarray, "segments places width"]]:
    """XᵀX and XᵀW, as if no observation touched an eliminated row, of X = (A, F) of narrow F with a
    place behind each, and of wide ones by their segments."""
    import scipy.sparse as sp

    A, F, of_wide = linear.A, roots.narrow, roots.segments
    behind = sp.csr_matrix((A.shape[0], 1))
    X = sp.hstack([A, behind, F, behind]).tocsr()
    X.sort_indices()
    with_narrow = np.zeros((X.shape[1],) * 2)
    with_wide = np.zeros((of_wide.number, X.shape[1], of_wide.within.shape[1]))
    for rows, columns, x in rows_of_equal_columns(X):
        with_narrow[columns[:, None], columns] += x.T @ x
        segment = of_wide.of_row[rows]
        for k in np.unique(segment[segment >= 0]):
            some = segment == k
            with_wide[k, columns] += x[some].T @ of_wide.within[rows[some]].toarray()
    return with_narrow, with_wide


def sums_of_wide(
    clusters: Sequence[Clusters],
    roots: RootColumns,
    sums: ClusterSums,
    is_chosen: Bool[np.ndarray, " clusters"],
) -> tuple[Matrix, Float[np.ndarray, " wide"]]:
    """AᵀPVPF and the diagonal of FᵀPVPF of mixed wide roots F, V − f from chosen clusters."""
    p, n, f = len(sums.AA) + 1, roots.narrow.shape[1], sums.mean_of_V
    AVF, FVF = np.zeros((p, roots.wide.shape[1])), np.zeros(roots.number - n)
    for c in chosen_portions(clusters, is_chosen, roots.number):
        A, F = c.without_fit(c.A.values), c.without_fit(roots.wide_rows(c.rows))
        V, mixed = not_none(c.V) - f * np.eye(c.rows.shape[1]), roots.mix(F)
        FVF += np.sum(V @ mixed * mixed, (0, 1))
        VA = V @ A
        for some in equal_neighbours(c.A.at):
            AVF[c.A.at[some.start]] += tall(VA[some]).T @ tall(F[some])
    share = len(is_chosen) / max(is_chosen.sum(), 1)
    AVF, diagonal = roots.mix(AVF[:-1]), np.diag(sums.FF)[n:]
    return f * sums.AF[:, n:] + share * AVF, f * diagonal + share * FVF


def chosen_portions(
    clusters: Sequence[Clusters], is_chosen: Bool[np.ndarray, " clusters"], columns: int
) -> Iterator[Clusters]:
    """Chosen clusters, some at a time."""
    begin = 0
    for of_equal_size in clusters:
        positions = np.flatnonzero(is_chosen[begin : begin + len(of_equal_size.rows)])
        begin += len(of_equal_size.rows)
        if len(positions):
            yield from of_equal_size.some(positions).portions(columns)


def tall(x: Batch) -> Matrix:
    """The rows of all clusters in one matrix."""
    m, k, columns = x.shape
    return x.reshape(m * k, columns)


def _powers(c: Clusters, V: Batch) -> Float[np.ndarray, "4"]:
    """Sums of tr((P·V)ⁿ)."""
    PV = c.without_fit(V)
    square = PV @ PV
    product = lambda x, y: np.sum(x * y.transpose(0, 2, 1))
    traces = product(PV, square), product(square, square)
    return np.array([np.trace(PV, axis1=1, axis2=2).sum(), product(PV, PV), *traces])
