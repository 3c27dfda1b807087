"""The unknowns that observations do not determine: null vectors of the reduced normal matrix,
scaled by the diagonal before the elimination, and singular blocks of eliminated rows."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxbundle.leastsquares.datum.by_table import directions_of_motions
from jaxbundle.leastsquares.datum.conditions import open_directions
from jaxbundle.leastsquares.equations.elimination import reduced_system
from jaxbundle.leastsquares.equations.normal import Normal, normal_equations
from jaxbundle.leastsquares.indexing.plan import Plan, Tangent
from jaxbundle.leastsquares.indexing.rows import Data, Declared, Values, lay_out_data
from jaxbundle.leastsquares.problem import Problem, pad_data, pad_values
from jaxbundle.leastsquares.quality.names import kept_unknowns, name_of
from jaxbundle.system.programs import compile_once
from jaxbundle.types import not_none

# Scaled eigenvalues of the normal matrix below this are rounding: undetermined directions. Ten
# times `elimination.PIVOT`: an eigenvalue is at most the smallest pivot, and a problem that failed
# on a pivot is to have at least one name.
SINGULAR_EIGENVALUE = 1e-12


def undetermined_unknowns(
    problem: Problem, values: Values, threshold: float = SINGULAR_EIGENVALUE
) -> list[str]:
    """The unknowns that the observations do not determine, most affected first. `threshold`: of the
    scaled eigenvalues; a larger one also finds unknowns that are hardly separated."""
    S, V, G = scaled_system(problem, values)
    rows = [] if V is None else _name_singular(problem, V)
    if not np.isfinite(S).all():
        return rows
    if G.shape[1]:  # The datum is fixed separately.
        q, _ = np.linalg.qr(G)
        # A one along every open motion: singular only in what the observations should determine.
        S = S + q @ q.T
    eigenvalues, vectors = np.linalg.eigh(S) if S.size else (np.zeros(0), S)
    # Rounding is a fraction of the largest eigenvalue (the sum of the last one: 0 without any).
    null = vectors[:, eigenvalues < threshold * max(1.0, eigenvalues[-1:].sum())]
    # Squared components: the part of each unknown in the null space, whatever basis eigh chose.
    share, names = (null**2).sum(1), kept_unknowns(problem)
    order = np.argsort(-share, kind="stable")
    # Squared components add up to 1 in every direction: one of 0.05 or less belongs to a
    # combination of more than twenty unknowns: a list of them would name no cause.
    return [str(name_of(problem, *names[i])) for i in order if share[i] > 0.05] + rows


def undetermined_eliminated_unknowns(problem: Problem, values: Values) -> list[str]:
    """The unknowns of eliminated rows that are undetermined even if all other unknowns are
    given."""
    if problem.plan.eliminated is None:
        return []
    values, data = pad_values(problem, values), pad_data(problem, problem.data)
    V = _eliminated_blocks(problem.declared, problem.plan, values, data)
    return _name_singular(problem, np.asarray(V))


@compile_once
def _eliminated_blocks(
    declared: Declared, plan: Plan, values: Values, data: Data
) -> Float[Array, "rows w w"] | None:
    *_, blocks = normal_equations(declared, plan, values, lay_out_data(plan, data))
    return blocks.eliminated


def scaled_system(
    problem: Problem, values: Values
) -> tuple[
    Float[np.ndarray, "n n"], Float[np.ndarray, "rows w w"] | None, Float[np.ndarray, "n defect"]
]:
    """S scaled by its diagonal before elimination, in the order of
    `kept_unknowns`; V of the eliminated rows (None: there are none); the open directions."""
    plan, data = problem.plan, pad_data(problem, problem.data)
    values = pad_values(problem, values)
    moves = None if plan.datum is None else directions_of_motions(problem.declared, values)
    system = _scale(problem.declared, plan, values, data, moves)
    S, V, G = jax.tree.map(np.asarray, system)
    return np.tril(S) + np.tril(S, -1).T, V, G


@compile_once
def _scale(
    declared: Declared, plan: Plan, values: Values, data: Data, moves: Tangent | None
) -> tuple[Float[Array, "n n"], Float[Array, "rows w w"] | None, Float[Array, "n defect"]]:
    *_, blocks = normal_equations(declared, plan, values, lay_out_data(plan, data))
    S, scale, *_ = reduced_system(Normal(plan, blocks), pin_datum=False)
    G = jnp.zeros((sum(plan.groups[g].free.size for g in plan.kept), 0))
    if plan.datum is not None:
        open_ones = open_directions(declared, plan, values, moves)
        rows = [open_ones[g] / scale[g][..., None] for g in plan.kept]
        G = jnp.concatenate([x.reshape(-1, x.shape[-1]) for x in rows])
    return S.matrix(plan, plan.kept), blocks.eliminated, G


def _name_singular(problem: Problem, V: Float[np.ndarray, "rows w w"]) -> list[str]:
    """The unknowns of eliminated rows with a singular block V."""
    e = not_none(problem.plan.eliminated)
    group, table = problem.plan.groups[e], problem.table(e)
    finite = np.asarray(np.isfinite(V).all((1, 2)))
    V = np.where(finite[:, None, None], V, np.eye(V.shape[1]))
    held_directions = 1.0 - np.asarray(group.free)
    V = V + held_directions[:, :, None] * np.eye(V.shape[1])
    diagonal = np.diagonal(V, axis1=1, axis2=2)
    scale = 1 / np.sqrt(np.where(diagonal > 0, diagonal, 1.0))
    smallest = np.linalg.eigvalsh(V * scale[:, :, None] * scale[:, None, :])[:, 0]
    weak = np.flatnonzero(finite & (smallest < SINGULAR_EIGENVALUE))
    rows = group.members[0].rows
    rows = weak if rows is None else np.asarray(rows)[weak]
    all_of = ", ".join(table.parameter(j) for j in range(table.space.width))
    return [f"{all_of} of {table.title} {table.label(int(row))}" for row in rows]
