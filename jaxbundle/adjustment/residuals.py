"""Observation equations of frame images for the refinement of scanner images.

Rotation changes are exp([δθ]×) ≈ 1 + [δθ]× + ½[δθ]×², exact for the first and second derivatives
at δθ = 0, which is the only place they are taken.
"""

import jax.numpy as jnp

from jaxbundle import cameras
from jaxbundle.geometry import (
    matrix_from_quaternion,
    omega_phi_kappa_near,
    retract_quaternion,
)


def image_residual(model, domain, free, rotation, centre, interior, point, xy, weight, change):
    """The two residuals of an image point, as scalars.

    **Arguments:** `rotation` (9 scalars, rows of M), `centre` (3), `interior` (the model's
    parameters), `point` (3), `xy` (2), `weight` (2, 1/σ); `change` = (δX0 (3), δθ (3), the
    changes of the parameters `free`, δX (3)).
    """
    d_centre, d_theta, d_interior, d_point = change
    interior = list(interior)
    for column, d in zip(free, d_interior):
        interior[column] = interior[column] + d
    X, Y, Z = (p + d - (c + e) for p, d, c, e in zip(point, d_point, centre, d_centre))
    ray = tuple(
        rotation[3 * i] * X + rotation[3 * i + 1] * Y + rotation[3 * i + 2] * Z for i in range(3)
    )
    turn = cross(d_theta, ray)
    ray = tuple(a + b + 0.5 * c for a, b, c in zip(ray, turn, cross(d_theta, turn)))
    vx, vy = cameras.residual(model, domain, tuple(interior), ray, xy)
    return weight[0] * vx, weight[1] * vy


def cross(a, b):
    """The vector product of two triples of scalars."""
    return (a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])


def exterior_residual(position, rotation, given, weight, d_image):
    """An image's exterior orientation against its prior (X0, Y0, Z0, ω, φ, κ) [6]."""
    M = matrix_from_quaternion(retract_quaternion(rotation, d_image[3:]))
    angles = omega_phi_kappa_near(M, given[3:])
    change = jnp.concatenate([position + d_image[:3], angles]) - given
    return weight * change
