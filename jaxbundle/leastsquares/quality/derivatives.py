"""The differentiable solution, `solve`: adjusted tables as a function of all data.

At the minimum, g(y, θ) = ∂(½vᵀPv)/∂y = 0. By the implicit function theorem

    exact:          dy/dθ = −H⁻¹·∂g/∂θ,           H = JᵀPJ + Σ p·v·∂²v
    Gauss–Newton:   dy/dθ = −(JᵀPJ)⁻¹·JᵀP·∂v/∂θ

The exact form is the derivative of the computed solution; finite differences confirm it. The
Gauss–Newton form is that of error propagation, (JᵀPJ)⁻¹JᵀP for the observations; the two
differ by the curvature, of the order of the residuals. Both use the structured
factorisation of the adjustment, so the cost is one solve per (co)tangent.

The exact form holds to any order, in forward, reverse and mixed mode: the equation g = 0 is
differentiated (`jaxbundle.implicit`) in the tangent space at the solution, together with `retract`,
its chart. A problem that may float is pinned meanwhile (by a penalty, zero in the
solution, on changes of as many unknowns as the defect) and then moved to its datum as a whole.
The Gauss–Newton form is not the gradient of a computed quantity: its derivative would depend on the
order of differentiation and is refused. Its derivatives with respect to weights are those of JᵀPv
with J constant.
"""

import dataclasses
from collections.abc import Callable
from typing import Any, Literal, get_args

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float

from jaxbundle.arguments import integer, one_of, positive
from jaxbundle.implicit import derivative_along, differentiable_once, implicit_root
from jaxbundle.leastsquares.datum import conditions as datum
from jaxbundle.leastsquares.equations import elimination
from jaxbundle.leastsquares.equations.hessian import SecondOrder, count_terms, equations_and_terms
from jaxbundle.leastsquares.equations.normal import Normal, normal_equations, zero_tangent
from jaxbundle.leastsquares.indexing.plan import Plan, Tangent
from jaxbundle.leastsquares.indexing.reduction import FACTORS
from jaxbundle.leastsquares.indexing.rows import (
    Data,
    Declared,
    Values,
    fill_places,
    lay_out_data,
    residuals,
)
from jaxbundle.leastsquares.iterations.retraction import representatives, retract
from jaxbundle.leastsquares.iterations.solver import half_square, minimise_compiled
from jaxbundle.leastsquares.iterations.stopping import converged
from jaxbundle.leastsquares.problem import Problem, complete_data, make_solver, without_filling
from jaxbundle.leastsquares.quality.hessian_products import multiply
from jaxbundle.system.programs import compile_once
from jaxbundle.types import not_none

Sensitivity = Literal["exact", "gauss-newton"]

FIRST_ORDER_ONLY = (
    'sensitivity = "gauss-newton" has first derivatives only: '
    'take second ones with sensitivity = "exact"'
)


def solve(
    problem: Problem,
    data: Data | None = None,
    *,
    sensitivity: Sensitivity = "exact",
    max_iterations: int = 100,
    atol: float = 1e-7,
    **options: Any,
) -> Values:
    """Adjusted tables as a differentiable function of the observations and all other data.

    Use it under `jax.jit`, `jax.vmap` (over any field of `data`), `jax.grad`, `jax.jacfwd` and
    `jax.jacrev`, nested to any order.

    **Arguments:**

    - `problem`: from `make_problem`.
    - `data`: numbers that replace `problem.data` (same shapes): start values, including held values
      and datum rows (a rotation is free or held as a whole), measurements, weights.
    - `sensitivity`: `"exact"` (implicit function theorem with the full Hessian) or
      `"gauss-newton"` ((JᵀPJ)⁻¹JᵀP, error propagation, first order only); see the module.
    - `max_iterations`: steps at most.
    - `atol`: stop when no unknown would move by more than this fraction of its σ.
    - `options`: of the solver, see `LeastSquares`.

    **Returns:** the tables; all NaN, including derivatives, if the solver did not converge, so that
    a failure is never mistaken for a solution.

    **Raises:** `InputError` for invalid arguments, and for a second derivative of the Gauss–Newton
    form.
    """
    one_of("sensitivity", sensitivity, get_args(Sensitivity))
    # One more: the first evaluation is of the start values.
    steps, atol = integer("max_iterations", max_iterations) + 1, positive("atol", atol)
    data = complete_data(problem, data)
    solver = make_solver(problem, atol=atol, max_steps=steps, **options)
    fixed = jax.lax.stop_gradient(data)
    minimum = minimise_compiled(solver, fixed, fixed.start)
    good = converged(minimum.termination)
    values = attach_derivatives(problem.declared, problem.plan, minimum.values, data, sensitivity)
    # A factor, not `where`: derivatives of a failed solution are NaN as well, not 0.
    tables = without_filling(problem, values)
    return jax.tree.map(lambda x: x * jnp.where(good, 1.0, jnp.nan), tables)


class LinearisedSolution(eqx.Module):
    """The problem at a solution, as a constant for the derivative rules. `pins`: of the penalty
    ½·Σ pins·δ² on changes of the kept unknowns: the diagonal elements of N where one is pinned,
    else 0, as in `factor` (empty if nothing is open). `terms`: of the exact Hessian, of small
    problems."""

    declared: Declared = eqx.field(static=True)
    plan: Plan
    values: Values
    data: Data
    factor: elimination.NormalFactor
    pins: Tangent
    terms: tuple[SecondOrder, ...] | None = None

    def hold_given(self, data: Data) -> Values:
        """The solution with held values taken from the start values."""
        free = datum.free_of_tables(self.declared, self.plan, self.values)
        return {
            name: jax.vmap(space.hold)(self.values[name], data.start[name], free[name])
            for name, space in self.declared.named_spaces
        }

    def residuals(self, change: Tangent, data: Data) -> tuple[Float[Array, "chunks length r"], ...]:
        """v/σ after a change of the unknowns."""
        plan, chunked = fill_places(self.plan, lay_out_data(self.plan, data))
        # Changes of held unknowns have no effect, so that their gradients are zero, not undefined.
        change = {name: x * plan.groups[name].free for name, x in change.items()}
        return residuals(self.declared, plan, self.move(change, data), chunked)

    def times(self, change: Tangent) -> Tangent:
        """H·δ of ½vᵀPv and of the penalty on the pins, from `terms`."""
        product = multiply(self.declared, self.plan, self.values, not_none(self.terms), change)
        penalty = {g: pins * change[g] for g, pins in self.pins.items()}
        return {g: x + penalty[g] if g in penalty else x for g, x in product.items()}

    def move(self, change: Tangent, data: Data) -> Values:
        return retract(self.declared, self.plan, self.hold_given(data), change)


@compile_once
def attach_derivatives(
    declared: Declared, plan: Plan, values: Values, data: Data, sensitivity: Sensitivity = "exact"
) -> Values:
    """The solution `values` for `data`, in its datum, differentiable with respect to every field of
    `data`.

    One or two more Newton steps make it exact, since the iterations end before the last digits
    converge."""
    values, fixed = jax.lax.stop_gradient((values, data))
    # The factor is that of the solution itself, where its derivatives are taken.
    values, _ = datum.move_to_datum(declared, plan, values, fixed.start)
    exact = sensitivity == "exact"
    # 32 MB of derivatives of single observations. Larger problems form each product with the
    # Hessian from the residuals: there memory counts, not the time to compile.
    if exact and count_terms(declared, plan) <= 4_000_000:
        linearised, step = _step_twice(declared, plan, values, fixed)
    else:
        linearised, step = _newton_step(declared, plan, values, fixed, exact)
    if sensitivity == "gauss-newton":
        change = datum.s_transform(declared, plan, values, step)
        return representatives(
            declared, linearised.move(_propagate(change, linearised, data), data), data.start
        )
    change = implicit_root(gradient_after, _solve_structured, step, linearised, data)
    tables = datum.attach_motion(declared, plan, linearised.move(change, data), data.start)
    return representatives(declared, tables, data.start)


def _newton_step(
    declared: Declared, plan: Plan, values: Values, data: Data, exact: bool, keep: bool = False
) -> tuple[LinearisedSolution, Tangent]:
    """The problem at the values, with the factor of the exact Hessian (and its terms, to `keep`) or
    of JᵀPJ; and the step from there."""
    chunked, terms = lay_out_data(plan, data), None
    if exact:
        equations, terms = equations_and_terms(declared, plan, values, chunked)
    else:
        equations = normal_equations(declared, plan, values, chunked)
    _, gradient, blocks = equations
    normal = Normal(plan, blocks)
    # Conjugate gradients tolerate open motions.
    pinned = plan.datum if plan.reduction in FACTORS else None
    pins, diagonal = {} if pinned is None else pinned.pins, normal.diagonal()
    pins = {g: p * jnp.where(diagonal[g] > 0, diagonal[g], 1.0) for g, p in pins.items()}
    factor = elimination.factorise(normal)
    # Along open motions the gradient is only rounding: that part is removed.
    gradient = datum.s_transform_transposed(declared, plan, values, gradient)
    step = jax.tree.map(jnp.negative, elimination.solve(factor, gradient))
    terms = terms if keep else None
    return LinearisedSolution(declared, plan, values, data, factor, pins, terms), step


def _step_twice(
    declared: Declared, plan: Plan, values: Values, data: Data
) -> tuple[LinearisedSolution, Tangent]:
    """`_newton_step` after another: the terms are those of the solution itself. In a loop, so that
    the program contains it once."""

    def take_step(values: Values, _: None) -> tuple[Values, tuple]:
        linearised, step = _newton_step(declared, plan, values, data, True, keep=True)
        return linearised.move(step, data), (
            values,
            linearised.factor,
            linearised.pins,
            linearised.terms,
            step,
        )

    _, both_steps = jax.lax.scan(take_step, values, length=2)
    *linearised, step = jax.tree.map(lambda x: x[-1], both_steps)
    values, factor, pins, terms = linearised
    return LinearisedSolution(declared, plan, values, data, factor, pins, terms), step


def gradient_after(change: Tangent, linearised: LinearisedSolution, data: Data) -> Tangent:
    """g of ½vᵀPv and of the penalty on the pins, after a change of the unknowns."""

    def penalised(change: Tangent) -> Float[Array, ""]:
        # It keeps as many unknowns as the defect from changing, so that H is regular; the motion
        # into the datum follows.
        penalty = sum(jnp.sum(pins * change[g] ** 2) for g, pins in linearised.pins.items())
        return half_square(linearised.plan, linearised.residuals(change, data)) + 0.5 * penalty

    return jax.grad(penalised)(change)


def _solve_structured(times: Callable, linearised: LinearisedSolution, b: Tangent) -> Tangent:
    """H⁻¹·b by the factor, differentiable as the solution of H·x = b.

    Refined once with the residual, computed without N: like the corrected seminormal equations
    (Björck 1987) it loses digits with the condition of the Jacobian, not its square. Second
    derivatives need this: those of the principal distance of four photographs (condition of scaled
    N: 1e7) have 9 digits with it, 5 without. Conjugate gradients already do this."""
    # In one vector: the transpose requires one linear function.
    right, unravel = ravel_pytree(b)
    flat = lambda tree: ravel_pytree(tree)[0]
    factor = lambda b: flat(elimination.solve(linearised.factor, unravel(b)))

    product = lambda x: flat(times(unravel(x)))
    quick = product if linearised.terms is None else lambda x: flat(linearised.times(unravel(x)))

    def improved(_: Callable, b: Float[Array, " n"]) -> Float[Array, " n"]:
        x = factor(b)
        return x + factor(b - quick(x)) if linearised.plan.reduction in FACTORS else x

    return unravel(jax.lax.custom_linear_solve(product, right, improved, symmetric=True))


@eqx.filter_custom_jvp
def _propagate(change: Tangent, linearised: LinearisedSolution, data: Data) -> Tangent:  # noqa: ARG001
    """`change` with the derivative of error propagation, which cannot be differentiated again."""
    return change


@_propagate.def_jvp
def _(primals: tuple, tangents: tuple) -> tuple[Tangent, Tangent]:
    change, at, data = primals
    data, still = differentiable_once(data, FIRST_ORDER_ONLY), zero_tangent(at.plan)

    def right(data: Data) -> Tangent:
        # J is constant except for its weights.
        constant = dataclasses.replace(at.data, weight=data.weight)
        transposed = jax.vjp(lambda change: at.residuals(change, constant), still)[1]
        return transposed(at.residuals(still, data))[0]

    step = elimination.solve(at.factor, derivative_along(right, data, tangents[-1]))
    start = derivative_along(lambda data: _change_of_start(at, data), data, tangents[-1])
    away = jax.tree.map(lambda x, d: -x - d, step, start)
    into = datum.s_transform(at.declared, at.plan, at.values, away)
    return change, jax.tree.map(jnp.add, into, start)


def _change_of_start(linearised: LinearisedSolution, data: Data) -> Tangent:
    """The change of the start values of datum unknowns from those that the solution was computed
    with: zero, but with derivatives."""
    changes = datum.zeros_of_tables(linearised.declared, linearised.values)
    for name in () if linearised.plan.datum is None else linearised.plan.datum.weight:
        difference = jax.vmap(linearised.declared.spaces[name].difference)
        changes[name] = difference(data.start[name], linearised.data.start[name])
    return datum.of_groups(linearised.plan, changes)
