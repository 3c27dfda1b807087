"""What errors of the observations do to a solution: their effects on unknowns and residuals.

With the rows A of all observations, in units of their σ, and N = AᵀA in the datum of the problem:

    x = N⁻¹(Aᵀe + Rᵀ),    M·e = e − A·N⁻¹Aᵀe,    D = R·N⁻¹Aᵀ

e errors, M·e what they leave in the residuals, R rows of linear functions of the unknowns. No
matrix is formed: columns go through the factor of the solution, some at a time.
"""

from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxbundle.leastsquares.datum.conditions import (
    of_groups,
    s_transform,
    s_transform_transposed,
    zeros_of_tables,
)
from jaxbundle.leastsquares.equations.elimination import NormalFactor, solve
from jaxbundle.leastsquares.equations.linearise import differentiate
from jaxbundle.leastsquares.equations.normal import zero_tangent
from jaxbundle.leastsquares.indexing.plan import Plan, Tangent
from jaxbundle.leastsquares.indexing.rows import (
    Data,
    Declared,
    Values,
    lay_out_data,
    prepare,
    residuals,
    restore_order,
)
from jaxbundle.leastsquares.solution import Solution
from jaxbundle.system.programs import compile_once
from jaxbundle.types import not_none

# Columns a call: half and double take the same time a column, and the last call is filled up.
AT_ONCE = 16


def stack_rows(
    solution: Solution, by_set: Mapping[str, Float[np.ndarray, "n r"]]
) -> Float[np.ndarray, " rows"]:
    """Residuals of all sets in one vector, in the order of the declarations."""
    return np.concatenate(
        [np.asarray(by_set[o.name]).ravel() for o in solution.problem.observations]
    )


def first_rows(solution: Solution) -> dict[str, int]:
    """Where the rows of each set begin in `stack_rows`."""
    sizes = [np.asarray(solution.residuals[o.name]).size for o in solution.problem.observations]
    starts = np.cumsum([0, *sizes])
    return {o.name: int(start) for o, start in zip(solution.problem.observations, starts)}


def remove_fit(
    solution: Solution, errors: Float[np.ndarray, "k rows"]
) -> tuple[Float[np.ndarray, "k rows"], dict[str, Float[np.ndarray, "k rows width"]]]:
    """What errors of the observations (units of their σ) leave in the residuals, M·e, and how they
    change the tables, N⁻¹Aᵀe in the datum of the problem."""
    return _solve_columns(solution, len(errors), errors, {})


def effects(
    solution: Solution, rows: Mapping[str, Float[np.ndarray, "f rows width"]]
) -> Float[np.ndarray, "f rows"]:
    """The change of linear functions of the changes of tables by one σ of every observation,
    D = R·N⁻¹Aᵀ, of the rows R of the functions."""
    number = len(next(iter(rows.values())))
    size = sum(np.asarray(solution.residuals[o.name]).size for o in solution.problem.observations)
    # Without errors the residuals are −A·N⁻¹Rᵀ.
    return -_solve_columns(solution, number, np.zeros((0, size)), rows)[0]


def residual_change(
    solution: Solution, table: str, direction: Float[np.ndarray, "n width"]
) -> Float[np.ndarray, " rows"]:
    """The derivative of all residuals, in units of their σ, along a direction of the values of a
    table of vectors, also of those that are held."""
    size = solution.problem.sizes["table", table]
    derivative = _derivative_along(*solution.arguments, table, _fill(direction, size))
    return _stack(solution, jax.tree.map(lambda x: np.asarray(x)[None], derivative))[0]


@compile_once
def _derivative_along(
    declared: Declared,
    plan: Plan,
    values: Values,
    data: Data,
    table: str,
    direction: Float[Array, "n width"],
) -> dict[str, Float[Array, "n r"]]:
    chunked = lay_out_data(plan, data)
    residuals_of = lambda x: restore_order(
        plan, residuals(declared, plan, {**values, table: x}, chunked)
    )
    return jax.jvp(residuals_of, (values[table],), (direction,))[1]


def _solve_columns(
    solution: Solution,
    number: int,
    errors: Float[np.ndarray, "k rows"],
    rows: Mapping[str, Float[np.ndarray, "f rows width"]],
) -> tuple[Float[np.ndarray, "n rows"], dict[str, Float[np.ndarray, "n rows width"]]]:
    """x = N⁻¹(Aᵀe + Rᵀ) by table and e − A·x, of a number of errors or of rows of functions."""
    remaining, changes = [], []
    tables = [
        (t.name, t.rows, solution.problem.sizes["table", t.name]) for t in solution.problem.tables
    ]
    no_rows = {t.name: np.zeros((0, t.rows, t.space.width)) for t in solution.problem.tables}
    for begin in range(0, number, AT_ONCE):
        # The last call is filled up, and tables to the sizes of the plan.
        some = lambda x, begin=begin: _fill(np.asarray(x)[begin : begin + AT_ONCE], AT_ONCE)
        padded_rows = {t: _fill(some(rows.get(t, no_rows[t])), size, 1) for t, _, size in tables}
        padded_remaining, changed = _solve(
            *solution.arguments, solution.factor, _unstack(solution, some(errors)), padded_rows
        )
        remaining.append(_stack(solution, padded_remaining))
        changes.append({t: np.asarray(changed[t])[:, :length] for t, length, _ in tables})
    by_table = {t: np.concatenate([x[t] for x in changes])[:number] for t, *_ in tables}
    return np.concatenate(remaining)[:number], by_table


def _fill(x: np.ndarray, length: int, axis: int = 0) -> np.ndarray:
    """The array with zeros behind it, up to a length of an axis."""
    room = [(0, length - n if k == axis else 0) for k, n in enumerate(x.shape)]
    return np.pad(x, room)


def _unstack(
    solution: Solution, errors: Float[np.ndarray, "k rows"]
) -> dict[str, Float[np.ndarray, "k n r"]]:
    """Rows of all sets, filled up to the sizes of the plan."""
    by_set, start, data = {}, 0, solution.arguments[3]
    for o in solution.problem.observations:
        n, r = np.asarray(solution.residuals[o.name]).shape
        rows = errors[:, start : start + n * r].reshape(len(errors), n, r)
        padding = len(data.weight[o.name]) - n
        by_set[o.name] = np.pad(rows, ((0, 0), (0, padding), (0, 0)))
        start += n * r
    return by_set


def _stack(solution: Solution, by_set: Mapping[str, Array]) -> Float[np.ndarray, "k rows"]:
    parts = [np.asarray(by_set[o.name])[:, : o.number] for o in solution.problem.observations]
    return np.concatenate([x.reshape(len(x), -1) for x in parts], 1)


@compile_once
def _solve(
    declared: Declared,
    plan: Plan,
    values: Values,
    data: Data,
    factor: NormalFactor,
    errors: dict[str, Float[Array, "k n r"]],
    rows: dict[str, Float[Array, "k rows width"]],
) -> tuple[dict[str, Float[Array, "k n r"]], dict[str, Float[Array, "k rows width"]]]:
    """`_solve_columns` of some columns: one program for errors and for functions."""
    forward, backward = _jacobian(declared, plan, values, data)

    def solve_one(errors_and_row: Any) -> tuple[Any, Any]:
        e, row = errors_and_row
        (right,) = backward(e)
        of_row = s_transform_transposed(declared, plan, values, of_groups(plan, row))
        x = solve(factor, jax.tree.map(jnp.add, right, of_row))
        remaining = jax.tree.map(jnp.subtract, e, forward(x))
        return remaining, _to_tables(declared, plan, values, s_transform(declared, plan, values, x))

    return jax.lax.map(solve_one, (errors, rows))


def _jacobian(declared: Declared, plan: Plan, values: Values, data: Data) -> tuple[Any, Any]:
    """A and Aᵀ, from changes of the groups to residuals by set in the given order, as products with
    the blocks of A: a tenth of the time of the derivative of the residuals along a change."""
    chunked, prepared = lay_out_data(plan, data), prepare(declared, values)
    numbers = range(len(plan.parts))
    blocks = [differentiate(declared, plan, k, prepared, chunked) for k in numbers]

    def forward(change: Tangent) -> dict[str, Float[Array, "n r"]]:
        by_part = []
        for part, (r, touches, E) in zip(plan.parts, blocks):
            rows = jnp.zeros_like(r)
            for touch, J in zip(part.touches, touches):
                x = change[touch.group][touch.row, touch.start : touch.stop]
                rows = rows + (J * x[:, None, None, :]).sum(-1)
            if E is not None:
                x = change[not_none(plan.eliminated)][part.eliminated]
                rows = rows + (E * x[:, :, None, :]).sum(-1)
            by_part.append(rows)
        return restore_order(plan, by_part)

    return forward, jax.linear_transpose(forward, zero_tangent(plan))


def _to_tables(
    declared: Declared, plan: Plan, values: Values, change: Tangent
) -> dict[str, Float[Array, "rows width"]]:
    """Changes of the groups as those of the tables; zero for held unknowns."""
    changes = zeros_of_tables(declared, values)
    for name, group in plan.groups.items():
        for m in group.members:
            part, rows = change[name][:, m.start : m.start + m.width], m.rows
            changes[m.table] = changes[m.table].at[slice(None) if rows is None else rows].add(part)
    return changes
