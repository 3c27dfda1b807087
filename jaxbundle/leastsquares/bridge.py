"""A bridge to the stock solvers of optimistix: their loop and damping, our elimination.

    fn, y0, linear_solver = stock_problem(problem)
    solver = optimistix.LevenbergMarquardt(1e-10, 1e-10, linear_solver=linear_solver)
    result = optimistix.least_squares(fn, solver, y0, args=problem.data)
    values = values_of(problem, result.value)

The stock solvers add steps, so the unknowns y are changes of the start values; their damping is
λ·1, so y is scaled by the columns of the Jacobian at the start. A linear solver sees the Jacobian
only as an operator, from which blocks cannot be read. Hence an additional unknown, the *witness*,
which is always 0, and additional outputs witness·x, also 0, for all quantities x that N depends on:
their derivative by the witness is x.
"""

# Arguments that the interface of lineax prescribes:
# ruff: noqa: ARG002

import dataclasses
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
from jaxtyping import Array, Float, PyTree

from jaxbundle.leastsquares.datum.conditions import zeros_of_tables
from jaxbundle.leastsquares.equations.elimination import NormalFactor, damp, factorise, solve
from jaxbundle.leastsquares.equations.normal import Normal, normal_equations, zero_tangent
from jaxbundle.leastsquares.indexing.plan import Plan, Tangent
from jaxbundle.leastsquares.indexing.rows import (
    Data,
    Declared,
    Values,
    fill_places,
    lay_out_data,
    residuals,
)
from jaxbundle.leastsquares.iterations.retraction import changes_of_tables
from jaxbundle.leastsquares.problem import Problem, pad_data, without_filling
from jaxbundle.leastsquares.spaces import Block, Change, Space, WithoutChart
from jaxbundle.types import AnyArray


@dataclasses.dataclass(frozen=True)
class Chart(WithoutChart):
    """A space in which changes add: a value is (start, scale, y) and represents the start changed
    by scale·y."""

    space: Space

    @property
    def width(self) -> int:
        return self.space.width

    def value(self, start: Any, scale: Float[Array, " width"], y: Float[Array, " width"]) -> Any:
        """The represented value."""
        return self.space.retract(start, scale * y)

    def prepare(self, value: tuple) -> tuple[Block, tuple[Change, ...]]:
        linearised_at, (start, scale, y) = self.value(*value), value
        change = lambda y: self.space.difference(self.value(start, scale, y), linearised_at)
        return self.space.prepare(linearised_at), tuple(map(tuple, jax.jacfwd(change)(y)))

    def move(self, block: tuple[Block, tuple[Change, ...]], change: Change) -> Block:
        prepared, slope = block
        moves = tuple(sum(a * d for a, d in zip(row, change)) for row in slope) if change else ()
        return self.space.move(prepared, moves)


def stock_problem(
    problem: Problem,
) -> tuple[Callable, tuple[Tangent, Float[Array, ""]], "EliminationOfJacobian"]:
    """Residual function fn(y, data), its start y0 = 0, and a linear solver for stock optimistix.

    **Raises:** `ValueError` if the datum is open: the stock loop has no datum."""
    if problem.counts.datum:
        raise ValueError("the stock solvers have no datum: fix it by held values or observations")
    charts = tuple((name, Chart(space)) for name, space in problem.declared.named_spaces)
    declared = dataclasses.replace(problem.declared, named_spaces=charts)
    plan, scale = problem.plan, _scale(problem)

    def fn(y: tuple[Tangent, Float[Array, ""]], data: Data) -> dict[str, PyTree]:
        change, witness = y
        data = pad_data(problem, data)
        values, chunked = _values(problem, data, scale, change), lay_out_data(plan, data)
        places, measured = fill_places(plan, chunked)
        # ∂(witness·x)/∂witness = x: how the linear solver gets the values at which N is formed.
        witnessed = jax.tree.map(lambda x: witness * x, (values, chunked))
        return {"residuals": residuals(declared, places, values, measured), "seen": witnessed}

    return fn, (zero_tangent(plan), jnp.zeros(())), EliminationOfJacobian(declared, plan)


def values_of(problem: Problem, y: tuple[Tangent, Float[Array, ""]]) -> Values:
    """The tables that belong to a result y of the stock solver."""
    values = _values(problem, pad_data(problem, problem.data), _scale(problem), y[0])
    charts = {name: Chart(space) for name, space in problem.declared.named_spaces}
    return without_filling(problem, {n: jax.vmap(charts[n].value)(*v) for n, v in values.items()})


def _values(
    problem: Problem, data: Data, scale: dict[str, AnyArray], change: Tangent
) -> dict[str, tuple]:
    """The tables as values of charts."""
    y = zeros_of_tables(problem.declared, data.start)
    y |= changes_of_tables(problem.plan, data.start, change)
    return {name: (start, scale[name], y[name]) for name, start in data.start.items()}


def _scale(problem: Problem) -> dict[str, AnyArray]:
    """By table, the unit change of each unknown."""
    return _columns(problem.declared, problem.plan, pad_data(problem, problem.data))


@eqx.filter_jit
def _columns(declared: Declared, plan: Plan, data: Data) -> dict[str, AnyArray]:
    *_, blocks = normal_equations(declared, plan, data.start, lay_out_data(plan, data))
    size = {g: jnp.where(d > 0, d, 1.0) ** -0.5 for g, d in Normal(plan, blocks).diagonal().items()}
    return zeros_of_tables(declared, data.start) | changes_of_tables(plan, data.start, size)


class EliminationOfJacobian(lx.AbstractLinearSolver):
    """Solves least squares for the Jacobian of `stock_problem`, optionally stacked on √λ·1."""

    declared: Declared = eqx.field(static=True)
    plan: Plan

    def init(
        self, operator: lx.AbstractLinearOperator, options: dict[str, Any]
    ) -> tuple[NormalFactor, lx.AbstractLinearOperator]:
        product, damping = operator.mv((zero_tangent(self.plan), jnp.ones(()))), jnp.zeros(())
        # Stock damping stacks √λ·1 below J: its product with the witness column is √λ.
        if isinstance(product, tuple):
            product, (_, root) = product
            damping = root**2
        *_, blocks = normal_equations(self.declared, self.plan, *product["seen"])
        ones = {g: jnp.ones(group.free.shape) for g, group in self.plan.groups.items()}
        normal = Normal(self.plan, dataclasses.replace(blocks, damping_matrix=ones))
        return factorise(damp(normal, damping)), operator

    def compute(
        self,
        state: tuple[NormalFactor, lx.AbstractLinearOperator],
        vector: PyTree,
        options: dict[str, Any],
    ) -> tuple[PyTree, lx.RESULTS, dict[str, Any]]:
        factor, operator = state
        right, _ = operator.transpose().mv(vector)
        return (solve(factor, right), jnp.zeros(())), lx.RESULTS.successful, {}

    def transpose(self, state: Any, options: dict[str, Any]) -> Any:
        raise NotImplementedError("no derivatives of the stock solvers: use leastsquares.solve")

    def conj(self, state: Any, options: dict[str, Any]) -> Any:
        return state, options

    def assume_full_rank(self) -> bool:
        return True
