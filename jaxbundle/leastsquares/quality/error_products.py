"""Products of the roots of error components with M, exactly, from reduced matrices.

With P, Q, A and S of `error_linearisation`, the products of roots F of few columns need only

    FᵀMF = FᵀPF − (AᵀPF)ᵀ·S⁻¹·AᵀPF

the reduced normal equations of an adjustment in which the columns of F are further unknowns of
cameras and photographs, summed over clusters of observations (`error_clusters`).

A component of many columns, V = F·Fᵀ with a block for every cluster, as of errors along tracks, is
kept as these blocks. With U = P·A·S^(−½), F̃ = M·F of the few columns, and of n = 1, 2, …

    l_n = tr((P·V)ⁿ),    a_n = Uᵀ·V·(P·V)ⁿ⁻¹·U

powers of M·V follow from det(1 − z·M·V) = det(1 − z·P·V)·det(1 + Σ zⁿ·a_n):

    tr(MV)     = l_1 − tr a_1
    tr((MV)²)  = l_2 − 2·tr a_2 + tr a_1²
    tr((MV)³)  = l_3 − 3·tr a_3 + 3·tr(a_1·a_2) − tr a_1³
    tr((MV)⁴)  = l_4 − 4·tr a_4 + 4·tr(a_1·a_3) + 2·tr a_2² − 4·tr(a_1²·a_2) + tr a_1⁴

l_n, a_1 and a_2 are exact, and tr(F̃ᵀVF̃) of roots with few values in a row. That of the others is
from some of the clusters where there are many; what only the skewness and the uncertainty of sizes
need, a_3, a_4 and F̃ᵀV(MV)ⁿF̃ in full, is from fewer of them.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

from jaxbundle.leastsquares.equations.reduced import DenseFactor
from jaxbundle.leastsquares.quality.error_clusters import (
    Batch,
    Clusters,
    equal_neighbours,
    find_clusters,
)
from jaxbundle.leastsquares.quality.error_linearisation import (
    LinearisedRows,
    datum_of,
    linearise_rows,
)
from jaxbundle.leastsquares.quality.error_sums import (
    chosen_portions,
    sum_products,
    sums_of_wide,
    tall,
)
from jaxbundle.leastsquares.quality.reduced_traces import Powers, ReducedTraces
from jaxbundle.leastsquares.quality.root_columns import Matrix, RootColumns, sort_roots
from jaxbundle.leastsquares.solution import Solution
from jaxbundle.types import not_none


class ErrorProducts:
    """Products of roots with M at a solution, and the changes of unknowns that they are; `few`: the
    products S = FᵀMF of all columns of few."""

    def __init__(
        self,
        solution: Solution,
        linear: LinearisedRows,
        clusters: Sequence[Clusters],
        roots: RootColumns,
        reduced: DenseFactor,
    ):
        self.solution, self.linear, self.clusters, self.roots = solution, linear, clusters, roots
        self.datum = datum_of(solution, linear)
        self.sums = sum_products(clusters, linear, roots, self.datum)
        # Of the conditions, what acts on kept unknowns, themselves and through eliminated rows.
        self.conditions = self.datum.conditions - self.sums.hA.T
        factor = solution.factor
        # The factor of the reduced system that the solution has anyway; Y = L⁻¹·D·AᵀPF, so that
        # (AᵀPF)ᵀ·S⁻¹·AᵀPF = YᵀY.
        self.lower = np.asarray(reduced.lower)
        scales = [np.asarray(factor.scale[g]).ravel() for g in solution.problem.plan.kept]
        self.scale = np.concatenate([np.zeros(0), *scales])[:, None]
        self.Y = self._forth(self.sums.AF)
        self.few = self.sums.FF - self.Y.T @ self.Y

    def _forth(self, x: Matrix) -> Matrix:
        """L⁻¹·D·x of S⁻¹ = D·L⁻ᵀ·L⁻¹·D."""
        from scipy.linalg import solve_triangular

        return solve_triangular(self.lower, self.scale * x, lower=True)

    def _back_substitute(self, x: Matrix) -> Matrix:
        """D·L⁻ᵀ·x."""
        from scipy.linalg import solve_triangular

        return self.scale * solve_triangular(self.lower, x, lower=True, trans=1)

    def changes(self) -> tuple[Matrix, Matrix]:
        """The changes of kept unknowns by the columns of the roots, N⁻¹AᵀF without the datum, and
        the motions a into it."""
        x, datum = self._back_substitute(self.Y), self.datum
        return x, datum.inverse @ (self.conditions.T @ x + self.sums.hF)

    def blocks_of_few(self, columns: slice, eliminated: bool) -> dict[str, np.ndarray]:
        """By group the covariance blocks X·Xᵀ that a component of few columns gives, of eliminated
        rows if wanted."""
        plan, datum = self.solution.problem.plan, self.datum
        x, a = (y[:, columns] for y in self.changes())
        in_datum, blocks, begin = x - datum.motions @ a, {}, 0
        for g in plan.kept:
            n, w = plan.groups[g].free.shape
            rows = in_datum[begin : begin + n * w].reshape(n, w, -1)
            blocks[g], begin = rows @ rows.transpose(0, 2, 1), begin + n * w
        if eliminated and plan.eliminated is not None:
            blocks[plan.eliminated] = self._eliminated_of_few(columns, x, a)
        return blocks

    def _eliminated_of_few(self, columns: slice, x: Matrix, a: Matrix) -> Batch:
        """The blocks of eliminated rows, whose changes are L⁻ᵀ·Qᵀ·(F − A·x) − G·a."""
        datum, number = self.datum, columns.stop - columns.start
        narrow = self.roots.narrow.shape[1]
        blocks = np.zeros((*datum.motions_eliminated.shape[:2], self.linear.Q.shape[1]))
        padded = np.concatenate([x, np.zeros((1, number))])
        for of_equal_size in self.clusters:
            if not of_equal_size.has_eliminated:
                continue
            for c in of_equal_size.portions(number):
                if columns.start >= narrow:
                    wide = slice(columns.start - narrow, columns.stop - narrow)
                    F = self.roots.mix(self.roots.wide_rows(c.rows))[:, :, wide]
                else:
                    F = c.F.spread(number, columns.start)
                turned = c.Q.transpose(0, 2, 1)
                QF, QA = turned @ F, turned @ c.A.values
                for some in equal_neighbours(c.A.at):
                    QF[some] -= QA[some] @ padded[c.A.at[some.start]]
                L = np.asarray(self.solution.factor.lower_inverse)[c.eliminated]
                change = L.transpose(0, 2, 1) @ QF - datum.motions_eliminated[c.eliminated] @ a
                blocks[c.eliminated] = change @ change.transpose(0, 2, 1)
        return blocks

    def blocks_of_block(self, eliminated: bool) -> dict[str, np.ndarray]:
        """`blocks_of_few` of the component with a block for every cluster."""
        plan, datum, p = self.solution.problem.plan, self.datum, self.linear.A.shape[1]
        d = datum.number
        # Errors e change the kept unknowns by x and the datum by a, both linear in two sums over
        # clusters, z = (x, a) = T·(Aᵀ·P·e, hᵀ·e), whose covariance is that of the sums.
        inverse = self._back_substitute(self._forth(np.eye(p)))
        onto = datum.inverse @ self.conditions.T @ inverse
        T = np.block([[inverse, np.zeros((p, d))], [onto, datum.inverse]])
        C = T @ np.block([[self.sums.AVA, self.sums.AVh], [self.sums.AVh.T, self.sums.hVh]]) @ T.T
        of_kept = np.concatenate([np.eye(p), -datum.motions], 1)
        in_datum, blocks, begin = of_kept @ C @ of_kept.T, {}, 0
        for g in plan.kept:
            n, w = plan.groups[g].free.shape
            rows = in_datum[begin : begin + n * w, begin : begin + n * w].reshape(n, w, n, w)
            blocks[g], begin = rows[np.arange(n), :, np.arange(n)], begin + n * w
        if eliminated and plan.eliminated is not None:
            blocks[plan.eliminated] = self._eliminated_of_block(T, C)
        return blocks

    def _eliminated_of_block(self, T: Matrix, C: Matrix) -> Batch:
        """The blocks of eliminated rows, whose changes are α·e − β·z."""
        datum, p = self.datum, self.linear.A.shape[1]
        all_blocks = np.zeros((*datum.motions_eliminated.shape[:2], self.linear.Q.shape[1]))
        # The last of A's places stands for none.
        T, C = (np.insert(np.insert(x, p, 0.0, 0), p, 0.0, 1) for x in (T, C))
        of_datum = np.arange(p + 1, len(T))
        for of_equal_size in self.clusters:
            if not of_equal_size.has_eliminated:
                continue
            for c in of_equal_size.portions(0):
                L = np.asarray(self.solution.factor.lower_inverse)[c.eliminated]
                alpha = L.transpose(0, 2, 1) @ c.Q.transpose(0, 2, 1)
                beta = np.concatenate(
                    [alpha @ c.A.values, datum.motions_eliminated[c.eliminated]], 2
                )
                Va = not_none(c.V) @ alpha.transpose(0, 2, 1)
                blocks = alpha @ Va
                # cov(z, e)·αᵀ: AᵀP·V·αᵀ, and hᵀV·αᵀ
                h = datum.effects(c.Q, c.eliminated)
                of_A, of_h = (x.transpose(0, 2, 1) for x in (c.A.values, h))
                onto = np.concatenate([of_A @ c.without_fit(Va), of_h @ Va], 1)
                for some in equal_neighbours(c.A.at):
                    columns = np.concatenate([c.A.at[some.start], of_datum])
                    square = columns[:, None], columns
                    b = beta[some]
                    cross = b @ (T[square] @ onto[some])
                    # cov(α·e − β·z) = α·V·αᵀ + β·C·βᵀ − β·cov(z, e)·αᵀ − its transpose
                    blocks[some] += b @ C[square] @ b.transpose(0, 2, 1)
                    blocks[some] -= cross + cross.transpose(0, 2, 1)
                all_blocks[c.eliminated] = blocks
        return all_blocks

    def powers(self, at_most: int, rng: np.random.Generator) -> "Powers":
        """Traces and products with powers of M·V of the component with a block for every cluster,
        what is not exact from `at_most` clusters."""
        s, q = self.sums, self.roots.number
        U = lambda x: self._forth(self._forth(x).T)
        # tr(F̃ᵀVF̃) by column, which T needs: from ten times as many clusters as what only the
        # skewness and the uncertainty of sizes need.
        number = sum(len(c.rows) for c in self.clusters)
        order = rng.permutation(number)
        is_chosen, is_of_T = np.zeros(number, bool), np.zeros(number, bool)
        is_chosen[order[:at_most]] = is_of_T[order[: 10 * at_most]] = True
        of_wide = sums_of_wide(self.clusters, self.roots, s, is_of_T)
        AVF, FVF = (np.concatenate(x, -1) for x in zip((s.AVF, s.FVF), of_wide))
        AVF = self._forth(AVF)
        # U = P·A·D·L⁻ᵀ, with UᵀU = 1: products with U are those with A, solved forth on both sides.
        a1, a2 = U(s.AVA), U(s.AVPVA)
        b1 = AVF - a1 @ self.Y
        diagonal = FVF - np.sum(self.Y * (AVF + b1), 0)
        # The identities of the module; none of these matrices is larger than kept unknowns.
        l = s.powers
        trace = np.trace
        t1 = l[0] - trace(a1)
        t2 = l[1] - 2 * trace(a2) + np.sum(a1 * a1)
        p = len(a1)
        a3, a4, b2, near, R2, R3 = (
            np.zeros(shape) for shape in (*[(p, p)] * 2, (p, q), *[(q, q)] * 3)
        )
        # Errors along a track are nearly independent ones, V ≈ f·1 with F̃ᵀVF̃ ≈ f·S: only the
        # difference is from some clusters.
        factor = t1 / max(self.solution.problem.counts.redundancy, 1)
        for c in chosen_portions(self.clusters, is_chosen, p + q):
            x0 = np.concatenate(self._dense(c), 2)
            V = not_none(c.V)
            # x0 = (U, F̃); V·x0, P·V·x0, V·P·V·x0, P·V·P·V·x0: products of two of them are all
            # powers up to the fourth.
            x1 = V @ x0
            x2 = c.without_fit(x1)
            x3 = V @ x2
            x4 = tall(c.without_fit(x3))
            x0, x1, x2, x3 = map(tall, (x0, x1, x2, x3))
            near += x0[:, p:].T @ (x1 - factor * x0)[:, p:]
            u2, f2 = x2[:, :p], x2[:, p:]
            b2 += u2.T @ f2
            a3 += u2.T @ x3[:, :p]
            a4 += x4[:, :p].T @ x4[:, :p]
            R2 += f2.T @ f2
            R3 += f2.T @ x3[:, p:]
        share = number / max(is_chosen.sum(), 1)
        a3, a4, b2, near, R2, R3 = (share * x for x in (a3, a4, b2, near, R2, R3))
        # From powers of P·V between F̃ to those of M·V: what the kept unknowns take is subtracted.
        R1 = factor * self.few + near
        np.fill_diagonal(R1, diagonal)  # as in T, so that both agree for independent errors
        R2 = R2 - b1.T @ b1
        cross = b1.T @ b2
        R3 = R3 - cross - cross.T + b1.T @ a1 @ b1
        t3 = l[2] - 3 * trace(a3) + 3 * np.sum(a1 * a2) - np.sum(a1 @ a1 * a1)
        square = a1 @ a1
        t4 = l[3] - 4 * trace(a4) + 4 * np.sum(a1 * a3) + 2 * np.sum(a2 * a2)
        t4 = t4 - 4 * np.sum(square * a2) + np.sum(square * square)
        return Powers(np.array([t1, t2, t3, t4]), diagonal, R1, R2, R3)

    def _dense(self, c: Clusters) -> tuple[Batch, Batch]:
        """U and F̃ of some clusters."""
        p, n = self.linear.A.shape[1], self.roots.narrow.shape[1]
        A = tall(c.without_fit(c.A.spread(p)))
        U = self._forth(A.T).T
        W = self.roots.mix(self.roots.wide_rows(c.rows))
        F = np.concatenate([c.F.spread(n), W], 2)
        F = tall(c.without_fit(F)) - U @ self.Y
        return U.reshape(*c.rows.shape, p), F.reshape(*c.rows.shape, F.shape[1])

    def traces(self, max_clusters: int, rng: np.random.Generator) -> ReducedTraces:
        """The traces of all components; `max_clusters`: see `powers`."""
        powers = self.powers(max_clusters, rng) if self.roots.many is not None else None
        redundancy = self.solution.problem.counts.redundancy
        return ReducedTraces(self.few, self.roots.of_components, powers, redundancy)

    def blocks(self, theta: Float[np.ndarray, " k"]) -> list[dict[str, np.ndarray]]:
        """By table the covariance blocks that every component of θ = 1 gives; of the eliminated
        table, and of the others of a component of many columns, only where its θ is not zero."""
        by_component: list[dict[str, np.ndarray]] = []
        for t, columns in zip(theta[1:], self.roots.of_components):
            if columns is None:
                blocks = self.blocks_of_block(bool(t != 0))
            else:
                blocks = self.blocks_of_few(columns, bool(t != 0))
            by_component.append(self._by_table(blocks))
        return by_component

    def _by_table(self, blocks: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
        """Blocks of groups as those of the rows of tables; zero for held unknowns."""
        problem, by_table = self.solution.problem, {}
        for table in problem.tables:
            members = [
                (g, m)
                for g in blocks
                for m in problem.plan.groups[g].members
                if m.table == table.name
            ]
            if not members and table.name == problem.plan.eliminated:
                continue
            width = table.space.width
            of_table = np.zeros((problem.sizes["table", table.name], width, width))
            for g, m in members:
                columns = slice(m.start, m.start + m.width)
                rows = np.arange(len(blocks[g])) if m.rows is None else np.asarray(m.rows)
                np.add.at(of_table, rows, blocks[g][:, columns, columns])
            by_table[table.name] = of_table[: table.rows]
        return by_table


def error_products(
    solution: Solution, roots: Sequence[tuple[Any, Matrix | None]], max_columns: int
) -> ErrorProducts | None:
    """The products of roots, sparse matrices [rows, columns] with what mixes their columns.

    None if the reduced system is not factorised densely, or if several have more than
    `max_columns` and their errors are shared by more than one cluster."""
    sorted_roots = sort_roots(roots, max_columns)
    reduced = solution.factor.reduced
    if sorted_roots is None or not isinstance(reduced, DenseFactor):
        return None
    linear = linearise_rows(solution)
    segment = sorted_roots.segments.of_row
    clusters = find_clusters(linear, sorted_roots.narrow, segment, sorted_roots.many)
    if clusters is None:
        return None
    return ErrorProducts(solution, linear, clusters, sorted_roots, reduced)
