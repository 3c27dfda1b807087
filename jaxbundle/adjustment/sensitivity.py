"""Derivatives of the adjusted unknowns with respect to everything that was given.

At the minimum, g(y, θ) = ∂(½vᵀPv)/∂y = 0. By the implicit function theorem

    exact:          dy/dθ = −H⁻¹·∂g/∂θ,           H = JᵀPJ + Σ p·v·∂²v
    Gauss–Newton:   dy/dθ = −(JᵀPJ)⁻¹·JᵀP·∂v/∂θ

The exact form is the derivative of what the program computes; finite differences confirm it. The
Gauss–Newton form is the one of error propagation, (JᵀPJ)⁻¹JᵀP for the observations; the two
differ by the curvature, of the order of the residuals. Both solve with the same structured
factorisation as the adjustment, so the cost is one solve for each (co)tangent.

The exact form holds to every order, in forward, reverse and mixed mode: g = 0 is differentiated
as an equation (`jaxbundle.implicit`), in the tangent space at the solution, and the chart of that
space (`retract`) with it: the second derivative of a quaternion is that of the quaternion returned.
A free network is pinned meanwhile (a penalty, 0 in the solution, on the changes of as many elements
of the exterior orientation as there are defects) and moved into its datum as a whole.

The Gauss–Newton form is not the gradient of anything that was computed: its own derivative would
depend on the order of differentiation, so it is refused. Weights count in it as in JᵀPv.
"""

from typing import Literal

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float

from jaxbundle.adjustment.datum import move_to_datum, s_transform
from jaxbundle.adjustment.jacobian import BundleJacobian, free_tangent, jacobian, zero_tangent
from jaxbundle.adjustment.normal import diagonal, hessian, normal_from_jacobian
from jaxbundle.adjustment.residuals import Residuals, half_square, residuals
from jaxbundle.adjustment.schur import Factor, factorise, solve
from jaxbundle.implicit import derivative_along, differentiable_once, implicit_root
from jaxbundle.network.arrays import Data, Tangent, Values, retract
from jaxbundle.network.structure import Structure

Sensitivity = Literal["exact", "gauss-newton"]

ONCE = (
    'sensitivity = "gauss-newton" has first derivatives only: '
    'take second ones with sensitivity = "exact"'
)


class Linearised(eqx.Module):
    """The network at a solution, held constant: what the rules for derivatives need of it.

    `pins`: the penalty on changes of the exterior orientations, in units of g (0: not pinned);
    `jac` where the form is that of Gauss and Newton.
    """

    structure: Structure
    values: Values
    data: Data
    factor: Factor
    pins: Float[Array, "images image_block"]
    jac: BundleJacobian | None


@eqx.filter_jit
def attach_derivatives(
    structure: Structure, values: Values, data: Data, sensitivity: Sensitivity = "exact"
) -> Values:
    """The solution `values` for `data`, differentiable with respect to every field of `data`.

    One more Newton step makes it exact: the iterations end before their last digits do."""
    exact = sensitivity == "exact"
    at = linearise(structure, *jax.lax.stop_gradient((values, data)), exact)
    zero = zero_tangent(structure)
    if not exact:
        rows = residuals(structure, at.values, at.data)
        step = s_transform(structure, at.values, solve(at.factor, at.jac.transposed_mv(rows)))
        change = _propagated(jax.tree.map(jnp.negative, step), at, data)
        return retract(structure, _with_given(structure, at.values, data), change)
    step = jax.tree.map(jnp.negative, solve(at.factor, _gradient(zero, at, at.data)))
    change = implicit_root(_gradient, _solve_structured, step, at, data)
    moved = retract(structure, _with_given(structure, at.values, data), change)
    return move_to_datum(structure, moved, data.start, derivatives=True)


def linearise(structure: Structure, values: Values, data: Data, exact: bool) -> Linearised:
    """The factor of the exact Hessian, or of JᵀPJ, at a solution."""
    jac = None if exact else jacobian(structure, values, data)
    blocks = hessian(structure, values, data) if exact else normal_from_jacobian(jac)
    regular = structure.defect and structure.reduction != "iterative"
    pins = structure.pins * diagonal(blocks).image if regular else jnp.zeros_like(structure.pins)
    factor = factorise(structure, blocks)
    return Linearised(structure, values, data, factor, pins, jac)


def _gradient(change: Tangent, at: Linearised, data: Data) -> Tangent:
    """g: that of ½vᵀPv, and of the penalty on the pins, after a change of the unknowns."""
    s = at.structure
    given, free = _with_given(s, at.values, data), free_tangent(s)

    def penalised(change):
        change = jax.tree.map(jnp.multiply, change, free)
        rows = residuals(s, retract(s, given, change), data)
        return half_square(rows) + 0.5 * jnp.sum(at.pins * change.image**2)

    return jax.grad(penalised)(change)


def _solve_structured(times, at: Linearised, b: Tangent) -> Tangent:
    """H⁻¹·b by the factor, differentiable as the solution of H·x = b.

    Improved once by what it leaves, found without N: as the seminormal equations corrected (Björck
    1987) it loses the condition of the Jacobian, not its square. Second derivatives need that: of
    the principal distance of four photographs (condition of N scaled: 1e7) they have 9 digits
    with it, 5 without. Conjugate gradients have done so themselves."""

    # In one vector: what is transposed must be linear as a whole.
    right, unravel = ravel_pytree(b)
    flat = lambda tree: ravel_pytree(tree)[0]
    factor = lambda b: flat(solve(at.factor, unravel(b)))

    def improved(times, b):
        x = factor(b)
        return x if at.structure.reduction == "iterative" else x + factor(b - times(x))

    product = lambda x: flat(times(unravel(x)))
    return unravel(jax.lax.custom_linear_solve(product, right, improved, symmetric=True))


@eqx.filter_custom_jvp
def _propagated(change: Tangent, at: Linearised, data: Data) -> Tangent:
    """`change` with the derivative of error propagation, which is not differentiated again."""
    return change


@_propagated.def_jvp
def _(primals, tangents):
    change, at, data = primals
    s, data = at.structure, differentiable_once(data, ONCE)

    def reweighted(data):
        rows = residuals(s, _with_given(s, at.values, data), data)
        return jax.tree.map(jnp.multiply, rows, _weight_ratios(data, at.data))

    # J is held constant but for the weights in it.
    moved = derivative_along(reweighted, data, tangents[-1])
    step = jax.tree.map(jnp.negative, solve(at.factor, at.jac.transposed_mv(moved)))
    return change, s_transform(s, at.values, step)


def _weight_ratios(data: Data, constant: Data) -> Residuals:
    """The weights in Jᵀ relative to the constant ones: 1, with a derivative."""
    ratio = lambda new, old: jnp.where(old > 0, new / jnp.where(old > 0, old, 1.0), 1.0)
    return Residuals(*(
        ratio(getattr(data, name), getattr(constant, name))
        for name in ("image_weight", "control_weight", "exterior_weight", "interior_weight",
                     "distance_weight")
    ))  # fmt: skip


def _with_given(structure: Structure, values: Values, data: Data) -> Values:
    """The solution with everything that was held taken from `data.start`, to carry derivatives."""
    s, start = structure, data.start
    pick = lambda free, solved, given: jnp.where(free > 0, solved, given)
    camera_free = jnp.zeros_like(values.camera)
    if s.interior_width:
        rows = jnp.arange(s.cameras)[:, None]
        camera_free = camera_free.at[rows, s.camera_columns].max(s.camera_free)
    return Values(
        camera=pick(camera_free, values.camera, start.camera),
        position=pick(s.image_free[:, :3], values.position, start.position),
        rotation=pick(s.image_free[:, 3:4], values.rotation, start.rotation),
        point=pick(s.point_free, values.point, start.point),
    )
