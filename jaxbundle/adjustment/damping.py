"""The metric of the damping: λ·D is added to N, and the step becomes shorter as λ grows.

Marquardt (1963) takes D = diag(N), which depends on what the unknowns are. For a pose it matters:
a turn δθ about the projection centre and a shift δX0 move the image nearly alike, and with both
damped lightly long steps of one against the other are tried and refused. In the unknowns of
programs that store [R t],

    δθ   a turn,
    δt   of t = −M·X0, the place of the origin of object space in the camera frame,

a turn is about that origin and weighs the more the farther away it is. D is diag(N) in these,
carried back to (δX0, δθ): D = Tᵀ·diag(T⁻ᵀ·N·T⁻¹)·T with T = ∂(δt, δθ)/∂(δX0, δθ), a block for each
image. Cameras and points have their diagonal.
"""

import jax
import jax.numpy as jnp

from jaxbundle.adjustment.normal import Normal, diagonal
from jaxbundle.geometry import matrix_from_quaternion
from jaxbundle.network.arrays import Tangent, Values


def metric(values: Values, normal: Normal) -> Tangent:
    """D: matrices [images, w, w] for the images, diagonals for cameras and points; 1 for what is
    held."""
    D = diagonal(normal)
    image = jax.vmap(_of_image)(values.position, values.rotation, normal.image)
    return Tangent(image, D.camera, D.point)


def times(D: Tangent, change: Tangent) -> Tangent:
    """D·δ."""
    image = jnp.einsum("nij,nj->ni", D.image, change.image)
    return Tangent(image, D.camera * change.camera, D.point * change.point)


def _of_image(position, rotation, N):
    M = matrix_from_quaternion(rotation)

    def shift(change):
        # exp([δθ]×) ≈ 1 + [δθ]×: the derivative is taken at 0 only.
        t = -M @ (position + change[:3])
        return t + jnp.cross(change[3:], t)

    T = jnp.eye(N.shape[0]).at[:3, :6].set(jax.jacfwd(shift)(jnp.zeros(6)))
    A, B = T[:3, :3], T[:3, 3:6]  # A = −M is orthogonal
    inverse = T.at[:3, :3].set(A.T).at[:3, 3:6].set(-A.T @ B)
    D = T.T @ (jnp.diagonal(inverse.T @ N @ inverse)[:, None] * T)
    return D + jnp.diag(jnp.where(jnp.diagonal(D) > 0, 0.0, 1.0))
