"""The response of a solution to single data: held quantities and measurements.

At the minimum g(y, θ) = ∂(½vᵀPv)/∂y = 0 for any data θ (`derivatives.py`), so that

    H·x = −∂g/∂θ                          x: how the unknowns follow one held quantity θ
    H·λ = f,     d(f·y)/dl = −λᵀ·∂g/∂l    how one function f·y follows every measurement l

The exact Hessian H is never formed: H·x and ∂g/∂θ are one derivative of g along (x, θ), forward
over reverse. The equations are solved by conjugate gradients, preconditioned by the factor of JᵀPJ
from the cofactors. It differs from H only by the curvature, so a few steps suffice. One loop is
compiled, containing g once: seconds, while the Jacobian of the whole adjustment in reverse mode
took minutes.
"""

import dataclasses
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, PyTree

from jaxbundle.errors import NotSolvedError
from jaxbundle.leastsquares.datum.conditions import attach_motion
from jaxbundle.leastsquares.equations.elimination import NormalFactor, solve
from jaxbundle.leastsquares.equations.normal import dot, zero_tangent
from jaxbundle.leastsquares.indexing.plan import Plan, Tangent
from jaxbundle.leastsquares.indexing.rows import Data, Declared, Values, restore_order
from jaxbundle.leastsquares.iterations.solver import half_square
from jaxbundle.leastsquares.quality.derivatives import LinearisedSolution, gradient_after
from jaxbundle.leastsquares.solution import Solution
from jaxbundle.system.programs import compile_once
from jaxbundle.types import AnyArray

# A change of data: table, row, and the change of the row's value.
Change = Sequence[tuple[str, int, PyTree]]


def follow(solution: Solution, changes: Sequence[Change], at_once: int = 16) -> Iterator[Values]:
    """The response of all tables to each change of held quantities: tangents of the values of every
    row, [≤ `at_once`, rows, …], some changes at a time, exact to first order.

    One program handles `at_once` changes in turn, the last ones padded with zeros; more at once
    save calls of milliseconds and need memory for the tables of each.

    **Raises:** `NotSolvedError` if the values are not a minimum."""
    declared, plan, values, data = solution.arguments
    zeros = jax.tree.map(np.asarray, values)
    for begin in range(0, len(changes), at_once):
        some = changes[begin : begin + at_once]
        held_changes = jax.tree.map(lambda x: np.zeros((at_once, *x.shape)), zeros)
        for k, change in enumerate(some):
            for table, row, amount in change:
                add = lambda x, a, k=k, row=row: np.add.at(x, (k, row), a)
                jax.tree.map(add, held_changes[table], amount)
        followed, residual = _follow(declared, plan, values, data, solution.factor, held_changes)
        _require_converged(residual)
        real = {t.name: np.s_[: len(some), : t.rows] for t in solution.problem.tables}
        yield {
            name: jax.tree.map(
                lambda x, real_rows=real_rows: np.asarray(x)[real_rows], followed[name]
            )
            for name, real_rows in real.items()
        }


def pull_back(
    solution: Solution, functions: Mapping[str, Float[AnyArray, "f rows width"]]
) -> dict[str, Float[np.ndarray, "f n r"]]:
    """The change of linear functions of the changes of tables by one σ (a priori) of every
    observation, by set.

    An observation with a covariance changes by a column of its root L. If the measurement is not
    one array with a number per residual, the residual is changed by −1, as by a measurement larger
    by σ.

    **Raises:** `NotSolvedError` if the values are not a minimum."""
    declared, plan, values, data = solution.arguments
    problem, number = solution.problem, len(next(iter(functions.values())))
    size = {t.name: problem.sizes["table", t.name] for t in problem.tables}
    wide = lambda t, x: np.pad(x, ((0, 0), (0, size[t] - x.shape[1]), (0, 0)))
    rows = {t: wide(t, np.asarray(x)) for t, x in functions.items()}
    pulled = [
        _pull_back(
            declared,
            plan,
            values,
            data,
            solution.factor,
            {t: x[k : k + 1] for t, x in rows.items()},
        )
        for k in range(number)
    ]
    _require_converged(np.array([residual for _, _, residual in pulled]))
    effects = {}
    for observation_set in problem.observations:
        o = observation_set.name
        of_residuals = np.concatenate([np.asarray(by[o]) for _, by, _ in pulled])
        weight, n = np.asarray(problem.data.weight[o]), observation_set.number
        effects[o] = of_residuals[:, :n]
        leaves = [jax.tree.leaves(slopes[o]) for slopes, *_ in pulled]
        is_one = len(leaves[0]) == 1 and leaves[0][0].size == of_residuals[0].size
        if weight.ndim == 2 and is_one:
            slope = np.concatenate([np.asarray(leaf) for (leaf,) in leaves])[:, :n]
            sigma = np.where(weight > 0, 1 / np.where(weight > 0, weight, 1.0), 0.0)
            effects[o] = slope.reshape(number, n, -1) * sigma
    return effects


def _require_converged(residuals: Float[AnyArray, " k"], max_residual: float = 1e-6) -> None:
    """Refuse equations that were not solved: six digits are more than anyone reads of a
    derivative, and a problem that is no clear minimum does not come near them."""
    worst = float(np.max(np.asarray(residuals)))
    if not worst < max_residual:
        raise NotSolvedError(
            "derivatives of the solution were not found: its residuals are so large, or so curved, "
            "that it is not a clear minimum"
        )


@compile_once
def _follow(
    declared: Declared,
    plan: Plan,
    values: Values,
    data: Data,
    factor: NormalFactor,
    held_changes: Values,
) -> tuple[Values, Float[Array, " changes"]]:
    linearised = LinearisedSolution(declared, plan, values, data, factor, {})
    zero_change = zero_tangent(plan)

    def follow_one(held_changes: Values) -> tuple[Values, Float[Array, ""]]:
        x, residual = _solve(linearised, zero_change, held_changes)
        tables_in_datum = lambda change, start: _in_datum(linearised, change, start)
        return jax.jvp(tables_in_datum, (zero_change, data.start), (x, held_changes))[1], residual

    return jax.lax.map(follow_one, held_changes)


@compile_once
def _pull_back(
    declared: Declared, plan: Plan, values: Values, data: Data, factor: NormalFactor, rows: Tangent
) -> tuple[PyTree, dict[str, Array], Float[Array, " f"]]:
    """Derivatives by measurements and by residuals, and the residual of the equations."""
    linearised = LinearisedSolution(declared, plan, values, data, factor, {})
    zero_change, unchanged = zero_tangent(plan), jax.tree.map(jnp.zeros_like, data.start)

    def changes(change: Tangent) -> Tangent:
        """The changes of all tables."""
        tables = _in_datum(linearised, change, data.start)
        difference_of = lambda name, space: jax.vmap(space.difference)(tables[name], values[name])
        return {name: difference_of(name, space) for name, space in declared.named_spaces}

    def pull_back_one(row: Tangent) -> tuple[PyTree, dict[str, Array], Float[Array, ""]]:
        (row,) = jax.vjp(changes, zero_change)[1](row)
        adjoint, residual = _solve(linearised, row, unchanged)

        def gradient_along(measured: PyTree) -> Float[Array, ""]:
            """λᵀ·g."""
            changed_data = dataclasses.replace(data, measured=measured)
            cost = lambda change: half_square(plan, linearised.residuals(change, changed_data))
            return jax.jvp(cost, (zero_change,), (adjoint,))[1]

        slopes = jax.tree.map(jnp.negative, jax.grad(gradient_along)(data.measured))
        residuals = lambda change: linearised.residuals(change, data)
        of_parts = jax.jvp(residuals, (zero_change,), (adjoint,))[1]
        return slopes, restore_order(plan, of_parts), residual

    return jax.lax.map(pull_back_one, rows)


def _in_datum(linearised: LinearisedSolution, change: Tangent, start: Values) -> Values:
    """The tables after a change, in the datum defined by `start`."""
    tables = linearised.move(change, dataclasses.replace(linearised.data, start=start))
    return attach_motion(linearised.declared, linearised.plan, tables, start)


def _solve(
    linearised: LinearisedSolution,
    right: Tangent,
    held_changes: Values,
    tolerance: float = 1e-11,
    max_steps: int = 50,
) -> tuple[Tangent, Float[Array, ""]]:
    """x of H·x = right − (∂g/∂θ)·held by conjugate gradients, and the relative residual (norm of
    N⁻¹).

    The first pass of the loop computes the right-hand side, so that the program contains g once.
    H is N and the curvature: with the factor of N the error falls in each step by about the ratio
    of the two, so that some steps reach `tolerance`, just above rounding. Where `max_steps` do not,
    the curvature is as large as N, and the point is no clear minimum."""
    plan, zero_change, start = linearised.plan, zero_tangent(linearised.plan), linearised.data.start
    plus = lambda a, factor, b: jax.tree.map(lambda a, b: a + factor * b, a, b)

    def product(x: Tangent, share: Float[Array, ""]) -> Tangent:
        """H·x + share·(∂g/∂θ)·held."""
        gradient = lambda change, start: gradient_after(
            change, linearised, dataclasses.replace(linearised.data, start=start)
        )
        held_part = jax.tree.map(lambda d: share * d, held_changes)
        return jax.jvp(gradient, (zero_change, start), (x, held_part))[1]

    def is_unsolved(state: tuple) -> Bool[Array, ""]:
        *_, size, begin, count = state
        is_open = (size > tolerance**2 * begin) & (count <= max_steps)
        return (count == 0) | is_open

    def one_step(state: tuple) -> tuple:
        x, residual, direction, size, begin, count = state
        # Pass 0 has x = 0 and direction 0: its product is (∂g/∂θ)·held, the right-hand side.
        is_first = count == 0
        curved = product(direction, jnp.where(is_first, 1.0, 0.0))
        curvature = dot(plan, direction, curved)
        step = jnp.where(is_first, 1.0, size / jnp.where(is_first, 1.0, curvature))
        x = plus(x, jnp.where(is_first, 0.0, step), direction)
        residual = plus(residual, -step, curved)
        preconditioned = solve(linearised.factor, residual)
        new = dot(plan, residual, preconditioned)
        beta = jnp.where(is_first, 0.0, new / jnp.where(is_first, 1.0, size))
        direction = plus(preconditioned, beta, direction)
        return x, residual, direction, new, jnp.where(is_first, new, begin), count + 1

    nothing: Any = jnp.zeros(())
    x, *_, size, begin, _ = jax.lax.while_loop(
        is_unsolved, one_step, (zero_change, right, zero_change, nothing, nothing, jnp.asarray(0))
    )
    return x, jnp.sqrt(jnp.where(begin == 0, 0.0, size / jnp.where(begin == 0, 1.0, begin)))
