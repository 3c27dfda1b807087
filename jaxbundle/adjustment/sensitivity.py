"""Derivatives of the adjusted unknowns with respect to everything that was given.

At the minimum, g(y, θ) = ∂(½vᵀPv)/∂y = 0. By the implicit function theorem

    exact:          dy/dθ = −H⁻¹·∂g/∂θ,           H = JᵀPJ + Σ p·v·∂²v
    Gauss–Newton:   dy/dθ = −(JᵀPJ)⁻¹·JᵀP·∂v/∂θ

The exact form is the derivative of what the program computes; finite differences confirm it. The
Gauss–Newton form is the one of error propagation, (JᵀPJ)⁻¹JᵀP for the observations; the two
differ by the curvature, of the order of the residuals. Both solve with the same structured
factorisation as the adjustment, so the cost is one solve for each (co)tangent.

They are attached to the solution by one Newton step whose matrix is held constant: right in
value, right in first derivatives (forward and reverse), not in second ones.
"""

from typing import Literal

import equinox as eqx
import jax
import jax.numpy as jnp

from jaxbundle.adjustment.datum import move_to_datum, s_transform
from jaxbundle.adjustment.jacobian import free_tangent, jacobian, zero_tangent
from jaxbundle.adjustment.normal import hessian, normal_from_jacobian
from jaxbundle.adjustment.residuals import half_square, residuals
from jaxbundle.adjustment.schur import factorise, solve
from jaxbundle.network.arrays import Data, Values, retract
from jaxbundle.network.structure import Structure

Sensitivity = Literal["exact", "gauss-newton"]


@eqx.filter_jit
def attach_derivatives(
    structure: Structure, values: Values, data: Data, sensitivity: Sensitivity = "exact"
) -> Values:
    """The solution `values` for `data`, differentiable with respect to every field of `data`."""
    values, constant = jax.lax.stop_gradient((values, data))
    exact = sensitivity == "exact"
    blocks = hessian if exact else _gauss_newton
    factor = factorise(structure, blocks(structure, values, constant))
    free = free_tangent(structure)
    given = _with_given(structure, values, data)

    def residual_of(tangent, base):
        tangent = jax.tree.map(jnp.multiply, tangent, free)
        return residuals(structure, retract(structure, base, tangent), data)

    zero = zero_tangent(structure)
    if exact:
        gradient = jax.grad(lambda t: half_square(residual_of(t, given)))(zero)
    else:
        # J is held constant: only the residual depends on what was given.
        jac = jacobian(structure, values, constant)
        gradient = jac.transposed_mv(residual_of(zero, given))
    step = jax.tree.map(jnp.negative, solve(factor, gradient))
    step = s_transform(structure, values, step)
    moved = retract(structure, given, step)
    # The datum is exact through its own finite transformation; to first order, through S.
    return move_to_datum(structure, moved, data.start, derivatives=True) if exact else moved


def _gauss_newton(structure, values, data):
    return normal_from_jacobian(jacobian(structure, values, data))


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
