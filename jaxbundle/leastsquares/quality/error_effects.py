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
    found: Solution, by_set: Mapping[str, Float[np.ndarray, "n r"]]
) -> Float[np.ndarray, " rows"]:
    """Residuals of all sets in one vector, in the order of the declarations."""
    return np.concatenate([np.asarray(by_set[o.name]).ravel() for o in found.problem.observations])


def first_rows(found: Solution) -> dict[str, int]:
    """Where the rows of each set begin in `stack_rows`."""
    sizes = [np.asarray(found.residuals[o.name]).size for o in found.problem.observations]
    starts = np.cumsum([0, *sizes])
    return {o.name: int(start) for o, start in zip(found.problem.observations, starts)}


def remove_fit(
    found: Solution, errors: Float[np.ndarray, "k rows"]
) -> tuple[Float[np.ndarray, "k rows"], dict[str, Float[np.ndarray, "k rows width"]]]:
    """What errors of the observations (units of their σ) leave in the residuals, M·e, and how they
    change the tables, N⁻¹Aᵀe in the datum of the problem."""
    return _solve_columns(found, len(errors), errors, {})


def effects(
    found: Solution, rows: Mapping[str, Float[np.ndarray, "f rows width"]]
) -> Float[np.ndarray, "f rows"]:
    """The change of linear functions of the changes of tables by one σ of every observation,
    D = R·N⁻¹Aᵀ, of the rows R of the functions."""
    number = len(next(iter(rows.values())))
    size = sum(np.asarray(found.residuals[o.name]).size for o in found.problem.observations)
    # Without errors the residuals are −A·N⁻¹Rᵀ.
    return -_solve_columns(found, number, np.zeros((0, size)), rows)[0]


def residual_change(
    found: Solution, table: str, direction: Float[np.ndarray, "n width"]
) -> Float[np.ndarray, " rows"]:
    """The derivative of all residuals, in units of their σ, along a direction of the values of a
    table of vectors, also of those that are held."""
    size = found.problem.sizes["table", table]
    along = _derivative_along(*found.arguments, table, _fill(direction, size))
    return _stack(found, jax.tree.map(lambda x: np.asarray(x)[None], along))[0]


@compile_once
def _derivative_along(
    declared: Declared,
    plan: Plan,
    values: Values,
    data: Data,
    table: str,
    direction: Float[Array, "n width"],
) -> dict[str, Float[Array, "n r"]]:
    laid = lay_out_data(plan, data)
    of = lambda x: restore_order(plan, residuals(declared, plan, {**values, table: x}, laid))
    return jax.jvp(of, (values[table],), (direction,))[1]


def _solve_columns(
    found: Solution,
    number: int,
    errors: Float[np.ndarray, "k rows"],
    rows: Mapping[str, Float[np.ndarray, "f rows width"]],
) -> tuple[Float[np.ndarray, "n rows"], dict[str, Float[np.ndarray, "n rows width"]]]:
    """x = N⁻¹(Aᵀe + Rᵀ) by table and e − A·x, of a number of errors or of rows of functions."""
    remaining, changes = [], []
    tables = [(t.name, t.rows, found.problem.sizes["table", t.name]) for t in found.problem.tables]
    none = {t.name: np.zeros((0, t.rows, t.space.width)) for t in found.problem.tables}
    for first in range(0, number, AT_ONCE):
        # The last call is filled up, and tables to the sizes of the plan.
        some = lambda x, first=first: _fill(np.asarray(x)[first : first + AT_ONCE], AT_ONCE)
        given = {t: _fill(some(rows.get(t, none[t])), size, 1) for t, _, size in tables}
        left, changed = _solve(*found.arguments, found.factor, _unstack(found, some(errors)), given)
        remaining.append(_stack(found, left))
        changes.append({t: np.asarray(changed[t])[:, :length] for t, length, _ in tables})
    by_table = {t: np.concatenate([x[t] for x in changes])[:number] for t, *_ in tables}
    return np.concatenate(remaining)[:number], by_table


def _fill(x: np.ndarray, length: int, axis: int = 0) -> np.ndarray:
    """The array with zeros behind it, up to a length of an axis."""
    room = [(0, length - n if k == axis else 0) for k, n in enumerate(x.shape)]
    return np.pad(x, room)


def _unstack(
    found: Solution, errors: Float[np.ndarray, "k rows"]
) -> dict[str, Float[np.ndarray, "k n r"]]:
    """Rows of all sets, filled up to the sizes of the plan."""
    given, start, data = {}, 0, found.arguments[3]
    for o in found.problem.observations:
        n, r = np.asarray(found.residuals[o.name]).shape
        rows = errors[:, start : start + n * r].reshape(len(errors), n, r)
        more = len(data.weight[o.name]) - n
        given[o.name] = np.pad(rows, ((0, 0), (0, more), (0, 0)))
        start += n * r
    return given


def _stack(found: Solution, by_set: Mapping[str, Array]) -> Float[np.ndarray, "k rows"]:
    parts = [np.asarray(by_set[o.name])[:, : o.number] for o in found.problem.observations]
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

    def solve_one(given: Any) -> tuple[Any, Any]:
        e, row = given
        (right,) = backward(e)
        of_row = s_transform_transposed(declared, plan, values, of_groups(plan, row))
        x = solve(factor, jax.tree.map(jnp.add, right, of_row))
        left = jax.tree.map(jnp.subtract, e, forward(x))
        return left, _to_tables(declared, plan, values, s_transform(declared, plan, values, x))

    return jax.lax.map(solve_one, (errors, rows))


def _jacobian(declared: Declared, plan: Plan, values: Values, data: Data) -> tuple[Any, Any]:
    """A and Aᵀ, from changes of the groups to residuals by set in the given order, as products with
    the blocks of A: a tenth of the time of the derivative of the residuals along a change."""
    laid, prepared = lay_out_data(plan, data), prepare(declared, values)
    numbers = range(len(plan.parts))
    blocks = [differentiate(declared, plan, k, prepared, laid) for k in numbers]

    def forward(change: Tangent) -> dict[str, Float[Array, "n r"]]:
        found = []
        for part, (r, touches, E) in zip(plan.parts, blocks):
            rows = jnp.zeros_like(r)
            for touch, J in zip(part.touches, touches):
                x = change[touch.group][touch.row, touch.start : touch.stop]
                rows = rows + (J * x[:, None, None, :]).sum(-1)
            if E is not None:
                x = change[not_none(plan.eliminated)][part.eliminated]
                rows = rows + (E * x[:, :, None, :]).sum(-1)
            found.append(rows)
        return restore_order(plan, found)

    return forward, jax.linear_transpose(forward, zero_tangent(plan))


def _to_tables(
    declared: Declared, plan: Plan, values: Values, change: Tangent
) -> dict[str, Float[Array, "rows width"]]:
    """Changes of the groups as those of the tables; zero for held unknowns."""
    found = zeros_of_tables(declared, values)
    for name, group in plan.groups.items():
        for m in group.members:
            part, rows = change[name][:, m.start : m.start + m.width], m.rows
            found[m.table] = found[m.table].at[slice(None) if rows is None else rows].add(part)
    return found
