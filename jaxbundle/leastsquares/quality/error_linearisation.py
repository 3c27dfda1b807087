"""The linearised observations of a solution, and its datum, as matrices.

With the rows A of the kept unknowns, E of the eliminated ones, V = EᵀE = L·Lᵀ block diagonal and
S = Aᵀ·P·A the reduced matrix (`equations.elimination`),

    P = 1 − E·V⁻¹·Eᵀ = 1 − Q·Qᵀ,    Q = E·L⁻ᵀ,    M = P − P·A·S⁻¹·Aᵀ·P
"""

from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Array, Float, Int

from jaxbundle.leastsquares.datum.conditions import contract, datum_directions
from jaxbundle.leastsquares.equations.linearise import differentiate
from jaxbundle.leastsquares.indexing.plan import Plan, Tangent
from jaxbundle.leastsquares.indexing.rows import Data, Declared, Values, lay_out_data, prepare
from jaxbundle.leastsquares.solution import Solution
from jaxbundle.system.programs import compile_once


class LinearisedRows(NamedTuple):
    """A as a sparse matrix [rows, kept unknowns], rows of all observations (`stack_rows`) in units
    of their σ, unknowns group by group; Q [rows, width] (zero without an eliminated row), and the
    eliminated row of every row, −1 if there is none."""

    A: Any
    Q: Float[np.ndarray, "rows width"]
    eliminated: Int[np.ndarray, " rows"]


def linearise_rows(solution: Solution) -> LinearisedRows:
    """The rows of all observations of a solution."""
    import scipy.sparse as sp

    plan = solution.problem.plan
    starts, total = {}, 0
    for o in solution.problem.observations:
        starts[o.name] = total
        total += np.asarray(solution.residuals[o.name]).size
    first_column, unknowns = {}, 0
    for g in plan.kept:
        first_column[g] = unknowns
        unknowns += plan.groups[g].free.size
    # Indices of 32 bits: half the memory, and what sparse matrices have.
    no_entries = np.zeros(0, np.int32)
    entries: list[tuple[np.ndarray, ...]] = [(no_entries, no_entries, np.zeros(0))]
    width = 0 if plan.eliminated is None else plan.groups[plan.eliminated].width
    Q, eliminated = np.zeros((total, width)), np.full(total, -1)
    numbers = {o.name: o.number for o in solution.problem.observations}
    for part, (touches, E) in zip(plan.parts, _derivatives(*solution.arguments)):
        n, (_, length) = numbers[part.set_name], part.source.shape
        place, source = np.asarray(part.place)[:n], np.asarray(part.source).ravel()
        # Observations of other parts of the set have an empty place.
        first_places = np.flatnonzero(source[np.minimum(place, len(source) - 1)] == np.arange(n))
        first_places = first_places[place[first_places] < len(source)]
        place = place[first_places]
        r = np.asarray(solution.residuals[part.set_name]).shape[1]
        row = (starts[part.set_name] + r * first_places)[:, None] + np.arange(r)
        for touch, J in zip(part.touches, touches):
            J = np.asarray(J).reshape(-1, *J.shape[2:])[place]
            wide = plan.groups[touch.group].width
            column = first_column[touch.group] + touch.start + wide * np.asarray(touch.row)
            column = column[place // length][:, None] + np.arange(J.shape[2])
            broadcast_ravelled = lambda x, shape: np.broadcast_to(x.astype(np.int32), shape).ravel()
            rows, columns = row[:, :, None], column[:, None, :]
            entries.append(
                (broadcast_ravelled(rows, J.shape), broadcast_ravelled(columns, J.shape), J.ravel())
            )
        if E is not None:
            eliminated_rows = np.asarray(part.eliminated).ravel()[place]
            # Q = E·L⁻ᵀ: with it P·x needs no solution of a point's equations.
            L = np.asarray(solution.factor.lower_inverse)[eliminated_rows]
            J = np.asarray(E).reshape(-1, *E.shape[2:])[place]
            Q[row] = J @ L.transpose(0, 2, 1)
            eliminated[row] = eliminated_rows[:, None]
    rows, columns, values = (np.concatenate(x) for x in zip(*entries))
    del entries
    A = sp.csr_matrix((values, (rows, columns)), shape=(total, unknowns))
    # Zeros are of held unknowns, and of observations without weight.
    A.eliminate_zeros()
    return LinearisedRows(A, Q, eliminated)


@compile_once
def _derivatives(declared: Declared, plan: Plan, values: Values, data: Data) -> list[Any]:
    """The blocks of the touches and of the eliminated rows of every part."""
    chunked, prepared = lay_out_data(plan, data), prepare(declared, values)
    numbers = range(len(plan.parts))
    return [differentiate(declared, plan, k, prepared, chunked)[1:] for k in numbers]


class DatumDirections(NamedTuple):
    """Open motions G and conditions B (`datum.conditions`) of kept unknowns and of eliminated rows,
    with which a change x becomes x − G·a, a = (BᵀG)⁻¹Bᵀx: `conditions` of kept unknowns;
    `of_eliminated`, L⁻¹·B_e; `inverse`, (BᵀG)⁻¹."""

    motions: Float[np.ndarray, "unknowns d"]
    motions_eliminated: Float[np.ndarray, "n width d"]
    conditions: Float[np.ndarray, "unknowns d"]
    of_eliminated: Float[np.ndarray, "n width d"]
    inverse: Float[np.ndarray, "d d"]

    @property
    def number(self) -> int:
        return len(self.inverse)

    def effects(
        self, Q: Float[np.ndarray, "m k width"], eliminated: Int[np.ndarray, " m"]
    ) -> Float[np.ndarray, "m k d"]:
        """h = E·V⁻¹·B_e, with which hᵀe is what errors of observations change in Bᵀx through their
        eliminated row (−1: they touch none)."""
        if not len(self.of_eliminated) or (eliminated < 0).any():
            return np.zeros((*Q.shape[:2], self.number))
        return Q @ self.of_eliminated[eliminated]


def datum_of(solution: Solution, linear: LinearisedRows) -> DatumDirections:
    """The datum of a solution; without columns if nothing is open."""
    plan, unknowns = solution.problem.plan, linear.A.shape[1]
    rows, width = 0, linear.Q.shape[1]
    if plan.eliminated is not None:
        rows = plan.groups[plan.eliminated].rows
    if plan.datum is None:
        no_columns = np.zeros((unknowns, 0)), np.zeros((rows, width, 0))
        return DatumDirections(*no_columns, *no_columns, np.zeros((0, 0)))
    declared, _, values, _ = solution.arguments
    directions = _directions(declared, plan, values, solution.moves)
    G, B, gram = jax.tree.map(np.asarray, directions)
    d = len(gram)
    stack_kept = lambda x: np.concatenate(
        [np.zeros((0, d)), *(x[g].reshape(-1, d) for g in plan.kept)]
    )
    of_eliminated = motions = np.zeros((rows, width, d))
    if (e := plan.eliminated) is not None:
        motions, of_eliminated = G[e], np.asarray(solution.factor.lower_inverse) @ B[e]
    kept = stack_kept(G), motions, stack_kept(B)
    return DatumDirections(*kept, of_eliminated, np.linalg.inv(gram))


@compile_once
def _directions(
    declared: Declared, plan: Plan, values: Values, moves: Tangent | None
) -> tuple[Tangent, Tangent, Float[Array, "d d"]]:
    G, B = datum_directions(declared, plan, values, moves)
    return G, B, contract(plan, B, G)
