"""Excluded rows, determined from the solution including its uncertainty.

With V and W of their own observations and Q of the solution,

    Q_XX = V⁻¹ + V⁻¹·Wᵀ·Q·W·V⁻¹.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxbundle.leastsquares.equations.normal import normal_equations
from jaxbundle.leastsquares.indexing.plan import Incidences, Plan, Tangent
from jaxbundle.leastsquares.indexing.rows import Data, Declared, Values, lay_out_data
from jaxbundle.leastsquares.iterations.retraction import changes_of_tables
from jaxbundle.leastsquares.problem import Problem, pad_data, pad_values, without_filling
from jaxbundle.leastsquares.solution import Solution
from jaxbundle.system.programs import compile_once
from jaxbundle.types import not_none


class DeterminedRows(NamedTuple):
    """Excluded rows from the solution: `values` of the tables; of each row V⁻¹ (`inverse`), and
    V⁻¹·Wᵀ as `functions` [width, rows, width] of the changes of the tables of the solution."""

    values: Values
    inverse: Float[np.ndarray, "rows width width"]
    functions: tuple[dict[str, Float[np.ndarray, "width rows width"]], ...]

    def cofactors(self, solution: Solution) -> Float[np.ndarray, "rows width width"]:
        """V⁻¹ is the intersection with images given; V⁻¹WᵀQWV⁻¹ what their own uncertainty adds,
        in the datum of the adjustment, by propagation of three linear functions for each point."""
        return np.array(
            [V + solution.propagate_rows(rows) for V, rows in zip(self.inverse, self.functions)]
        )


def determine_excluded(solution: Solution, problem: Problem) -> DeterminedRows:
    """The eliminated rows of a problem whose other tables are those of a solution.

    **Arguments:** `problem`: with the kept tables of the solution's problem, at their adjusted
    values and with the same free unknowns.
    """
    plan, e = problem.plan, not_none(problem.plan.eliminated)
    data = pad_data(problem, problem.data)
    values, inverse, products = _intersect(problem.declared, plan, data)
    number, functions_by_row = problem.table(e).rows, []
    blank = {t.name: np.zeros((t.rows, t.space.width)) for t in solution.problem.tables}
    by_row = {g: _by_row(at, W) for (g, W), at in zip(products.items(), plan.incidences.values())}
    start = pad_values(problem, problem.data.start)
    for row in range(number):
        functions = []
        for i in range(inverse.shape[1]):
            change = {name: np.zeros(group.free.shape) for name, group in plan.groups.items()}
            for g, (eliminated, kept, W) in by_row.items():
                incidences_of_row = slice(*np.searchsorted(eliminated, [row, row + 1]))
                np.add.at(change[g], kept[incidences_of_row], W[incidences_of_row, i])
            tables = changes_of_tables(plan, start, change)
            tables.pop(e)
            functions.append(blank | {t: np.asarray(x)[: len(blank[t])] for t, x in tables.items()})
        functions_by_row.append({t: np.stack([f[t] for f in functions]) for t in blank})
    return DeterminedRows(
        without_filling(problem, values), np.asarray(inverse)[:number], tuple(functions_by_row)
    )


def _by_row(
    incidences: Incidences, W: Float[Array, "chunks length w v"]
) -> tuple[Int[np.ndarray, " n"], Int[np.ndarray, " n"], Float[np.ndarray, "n w v"]]:
    """The incidences of a group sorted by eliminated row: that, the row of the group, V⁻¹·Wᵀ."""
    eliminated = np.asarray(incidences.eliminated).ravel()
    reduced_row = np.repeat(np.asarray(incidences.row), incidences.eliminated.shape[1])
    order = np.argsort(eliminated, kind="stable")
    return eliminated[order], reduced_row[order], np.asarray(W).reshape(-1, *W.shape[2:])[order]


@compile_once
def _intersect(
    declared: Declared, plan: Plan, data: Data, steps: int = 20
) -> tuple[Values, Float[Array, "rows w w"], Tangent]:
    """The eliminated rows with all others given, by Gauss–Newton steps; V⁻¹, and V⁻¹·Wᵀ of every
    incidence. All steps are taken, more than converging rows need: one loop for all rows would
    wait for the slowest."""
    chunked, e = lay_out_data(plan, data), not_none(plan.eliminated)
    group = plan.groups[e]
    held_directions = (1.0 - group.free)[:, :, None] * jnp.eye(group.width)
    space = declared.spaces[e]

    def one_step(values: Values, _: None) -> tuple[Values, None]:
        _, gradient, N = normal_equations(declared, plan, values, chunked)
        step = -jnp.linalg.solve(N.eliminated + held_directions, gradient[e][..., None])[..., 0]
        return values | {e: jax.vmap(space.retract)(values[e], step)}, None

    values, _ = jax.lax.scan(one_step, data.start, None, steps)
    *_, N = normal_equations(declared, plan, values, chunked)
    inverse = jnp.linalg.inv(N.eliminated + held_directions)
    inverse_of = lambda g: inverse[plan.incidences[g].eliminated]
    return (
        values,
        inverse,
        {g: jnp.einsum("clij,cljk->clik", inverse_of(g), W) for g, W in N.W.items()},
    )
