"""What observations hardly determine: the weakest directions, by the names of unknowns.

The σ of an unknown means little by itself; it is compared with an *extent* e: that of a position
with a distance, that of an angle with a radian. With E = diag(e), the datum S and Q = N⁻¹, the
largest eigenvalues μ of

    A = E⁻¹·S·Q·Sᵀ·E⁻¹

belong to the weakest directions, and no σ is larger than σ0·√μ₁ extents. They are found by subspace
iteration (Golub and Van Loan, Matrix Computations, section 8.2.4): a few solves with the
existing factor, never an inverse; if the cofactors are available, the σ are taken from them.
Unknowns without an extent are not judged. Eliminated rows are judged by their σ with everything
else given.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxbundle.leastsquares.datum.conditions import s_transform, s_transform_transposed
from jaxbundle.leastsquares.equations.elimination import (
    NormalFactor,
    factorise,
    regularise_diagonal,
    solve,
)
from jaxbundle.leastsquares.equations.normal import Normal, normal_equations
from jaxbundle.leastsquares.equations.reduced import flat, split_by_group
from jaxbundle.leastsquares.indexing.plan import Plan, Tangent
from jaxbundle.leastsquares.indexing.reduction import FACTORS
from jaxbundle.leastsquares.indexing.rows import Data, Declared, Values, lay_out_data
from jaxbundle.leastsquares.problem import Problem
from jaxbundle.leastsquares.quality.names import kept_unknowns, name_of
from jaxbundle.leastsquares.solution import Solution, with_plan, without_plan
from jaxbundle.system.programs import compile_once

# An unknown is poorly determined if its σ is above a fiftieth of its extent (1.1° of a rotation,
# 2 cm a metre away). A choice, not a measurement: what is meant to be determined is hundreds of
# times better.
VAGUE_RATIO = 50.0
# A row whose σ is above a tenth of its extent: at 3 σ, errors of the second order in it, (3/10)²/2,
# are no longer small beside those that least squares propagate.
NONLINEAR_RATIO = 10.0
# Reduced systems with fewer unknowns have their cofactors computed for this: the inverse of 1000
# takes less than compiling the subspace iteration.
SMALL_SYSTEM = 1000

# 1/e by table, [rows, width]; of the eliminated table e [rows], 0 where a row is not judged.
Extents = dict[str, Float[np.ndarray, "rows *width"]]


@dataclasses.dataclass(frozen=True)
class Weak:
    """`names` of kept unknowns with a σ above 1/`VAGUE_RATIO` of their extent, the weakest first;
    `worst`: the largest of these ratios. `rows`: eliminated ones with a σ above 1/`NONLINEAR_RATIO`
    of theirs; `judged`: number of rows compared."""

    names: tuple[str, ...] = ()
    worst: float = 0.0
    rows: tuple[int, ...] = ()
    judged: int = 0


def find_weak(
    solution: Solution, extents: Extents, sigma0: float, explained: Extents | None = None
) -> Weak:
    """The weak directions of a solution; none without a factor. `explained`: cofactors of its
    unknowns, by table, that are not counted, such as those of a common motion."""
    if solution.problem.plan.reduction not in FACTORS:
        return Weak()
    at_hand = "cofactors" in vars(solution) or len(kept_unknowns(solution.problem)) < SMALL_SYSTEM
    return _weak(solution, solution.factor, extents, sigma0, at_hand, explained)


def find_weak_unsolved(solution: Solution, extents: Extents) -> Weak:
    """The weak directions where iterations ended without a solution, by σ a priori: the normal
    equations get a small ridge, so that there is a factor."""
    if solution.problem.plan.reduction not in FACTORS:
        return Weak()
    factor = with_plan(_regularised_factor(*solution.arguments), solution.problem.plan)
    return _weak(solution, factor, extents, 1.0)


@compile_once
def _regularised_factor(declared: Declared, plan: Plan, values: Values, data: Data) -> NormalFactor:
    *_, blocks = normal_equations(declared, plan, values, lay_out_data(plan, data))
    return without_plan(factorise(regularise_diagonal(Normal(plan, blocks))))


def _weak(
    solution: Solution,
    factor: NormalFactor,
    extents: Extents,
    sigma0: float,
    at_hand: bool = False,
    explained: Extents | None = None,
) -> Weak:
    problem, plan = solution.problem, solution.problem.plan
    sigma0 = sigma0 if np.isfinite(sigma0) else 1.0
    if not np.isfinite(np.asarray(factor.reduced.pivots)).all():
        return Weak()
    far_rows, judged = _far_rows(problem, factor, extents, sigma0)
    if far_rows is None:
        return Weak()
    per_extent = _of_columns(problem, extents)
    if at_hand:
        blocks = solution.cofactors.diagonal_blocks
        variance = {g: np.diagonal(np.asarray(blocks[g]), axis1=1, axis2=2) for g in plan.kept}
        sigma = np.sqrt(np.asarray(flat(plan.kept, variance))) * per_extent
    else:
        sigma = _sigma_of_weakest(solution, factor, per_extent)
    if explained is not None:
        explained_part = per_extent**2 * _of_columns(problem, explained)
        sigma = np.sqrt(np.maximum(sigma**2 - explained_part, 0.0))
    sigma = sigma0 * sigma
    order = np.argsort(-sigma, kind="stable")[: (VAGUE_RATIO * sigma > 1).sum()]
    names = kept_unknowns(problem) if len(order) else []
    return Weak(
        tuple(str(name_of(problem, *names[k])) for k in order),
        float(sigma.max(initial=0.0)),
        far_rows,
        judged,
    )


def _far_rows(
    problem: Problem, factor: NormalFactor, extents: Extents, sigma0: float
) -> tuple[tuple[int, ...] | None, int]:
    """Eliminated rows with large σ, the worst first, and how many were judged; None where their
    factor is not finite."""
    e = problem.plan.eliminated
    if e is None or e not in extents:
        return (), 0
    L, members = np.asarray(factor.lower_inverse), problem.plan.groups[e].members
    if not np.isfinite(L).all():
        return None, 0
    size = problem.table(e).rows
    rows = np.arange(len(L)) if members[0].rows is None else np.asarray(members[0].rows)
    real = rows < size
    rows, free = rows[real], np.asarray(problem.plan.groups[e].free)[real]
    extent = extents[e][rows]
    judged = free.any(1) & (extent > 0)
    # L⁻¹ has a one for a held unknown, whose σ is 0 (`elimination.eliminate`).
    sigma = np.sqrt((L[real] ** 2 * free[:, None, :]).sum((1, 2))) * sigma0
    ratio = np.where(judged, sigma / np.where(judged, extent, 1.0), 0.0)
    order = np.argsort(-ratio, kind="stable")[: (NONLINEAR_RATIO * ratio > 1).sum()]
    return tuple(rows[order].tolist()), int(judged.sum())


def _of_columns(problem: Problem, by_table: Extents) -> Float[np.ndarray, " reduced"]:
    """Quantities by table, such as 1/e, as those of the columns of the reduced system; 0 for what
    is held or has none."""
    plan, columns = problem.plan, {}
    for g in plan.kept:
        group = plan.groups[g]
        columns[g] = np.zeros(group.free.shape)
        for m in group.members:
            if m.table not in by_table:
                continue
            quantity = by_table[m.table]
            if quantity.ndim == 1:  # Kept rows of the eliminated table.
                quantity = np.where(quantity > 0, 1 / np.where(quantity > 0, quantity, 1.0), 0.0)[
                    :, None
                ]
            rows = np.arange(group.rows) if m.rows is None else np.asarray(m.rows)
            real = np.flatnonzero(rows < len(quantity))
            columns[g][real, m.start : m.start + m.width] = quantity[rows[real]]
        columns[g] *= np.asarray(group.free)
    return np.asarray(flat(plan.kept, columns))


def _sigma_of_weakest(
    solution: Solution, factor: NormalFactor, per_extent: Float[np.ndarray, " reduced"]
) -> Float[np.ndarray, " reduced"]:
    """σ/e (a priori) of the reduced system's columns, as far as the weakest directions give it."""
    # Six directions: a free camera, a pose or a similarity hidden in the datum can be weak as a
    # whole. The last of the 8 products is that of Rayleigh and Ritz; in the directions after the 7
    # before it, the part of those with σ of less than half is below 1/4⁷.
    directions = np.random.default_rng(0).standard_normal((6, len(per_extent)))
    for _ in range(8):
        directions = np.linalg.qr(directions.T)[0].T
        previous = directions
        declared, _, values, _ = solution.arguments
        directions = np.asarray(
            _products(declared, values, factor, solution.moves, per_extent, directions)
        )
    # Rayleigh and Ritz: A restricted to the subspace has the largest eigenvalues μ, and the σ² of
    # an unknown is Σ μ·(component)².
    mu, turn = np.linalg.eigh(previous @ directions.T)
    return np.sqrt(np.maximum(mu, 0) @ (turn.T @ previous) ** 2)


@compile_once
def _products(
    declared: Declared,
    values: Values,
    factor: NormalFactor,
    moves: Tangent | None,
    per_extent: Float[Array, " reduced"],
    directions: Float[Array, "m reduced"],
) -> Float[Array, "m reduced"]:
    """A times each of the directions [m, reduced]."""
    plan = factor.plan
    zero_change = {name: jnp.zeros(group.free.shape) for name, group in plan.groups.items()}

    def product(direction: Float[Array, " reduced"]) -> Float[Array, " reduced"]:
        right = zero_change | split_by_group(plan, plan.kept, direction * per_extent)
        right = s_transform_transposed(declared, plan, values, right, moves)
        change = s_transform(declared, plan, values, solve(factor, right), moves)
        return flat(plan.kept, change) * per_extent

    return jax.vmap(product)(directions)
