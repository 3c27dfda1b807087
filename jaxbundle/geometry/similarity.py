"""Similarity of the object space: seven parameters, and the Helmert matrix of the datum.

    τ = (tx, ty, tz, ωx, ωy, ωz, s),        X' = exp(s)·Rs·X + t,        Rs = exp([ω]×)

t in the object unit, ω in radians, s the logarithm of the scale: τ = 0 is the identity, and the
first-order change is t + ω × X + s·X. A camera moves with its object when its projection centre
is transformed like a point and its rotation becomes M·Rsᵀ: then

    M·Rsᵀ·(X' − X0') = exp(s)·M·(X − X0),

and no image coordinate changes. That is the datum defect of a free network. The Helmert matrix G
spans its null space; it is the derivative of the transformation at τ = 0,

    points  ∂X'/∂τ = [ I  −[X]×  X ],        poses  ∂(X0', δθ)/∂τ = ⎡ I  −[X0]×  X0 ⎤
                                                                    ⎣ 0    −M    0  ⎦

(Granshaw, 1980, Photogrammetric Record 10(56)).
"""

import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Float

from jaxbundle.geometry.quaternions import (
    matrix_from_quaternion,
    matrix_from_rotation_vector,
    quaternion_conjugate,
    quaternion_from_rotation_vector,
    quaternion_multiply,
    rotation_vector_from_quaternion,
    traced_once,
)
from jaxbundle.types import AnyArray


@traced_once
def transform_point(tau: Float[AnyArray, "7"], X: Float[AnyArray, "3"]) -> Float[Array, "3"]:
    """X' = exp(s)·Rs·X + t, in the object unit."""
    return jnp.exp(tau[6]) * matrix_from_rotation_vector(tau[3:6]) @ X + tau[:3]


def transform_pose(
    tau: Float[AnyArray, "7"], X0: Float[AnyArray, "3"], q: Float[AnyArray, "4"]
) -> tuple[Float[Array, "3"], Float[Array, "4"]]:
    """Projection centre (object unit) and camera rotation M(q) that move with the object.

    Returns X0' = exp(s)·Rs·X0 + t and the unit quaternion of M·Rsᵀ. Image coordinates of the
    transformed points are unchanged.
    """
    rotation = quaternion_from_rotation_vector(tau[3:6])
    return transform_point(tau, X0), quaternion_multiply(q, quaternion_conjugate(rotation))


def inverse(tau: Float[AnyArray, "7"]) -> Float[Array, "7"]:
    """The parameters of X = exp(−s)·Rsᵀ·(X' − t)."""
    # X = exp(−s)·Rsᵀ·X' − exp(−s)·Rsᵀ·t: the shift goes through the rotation that leads back.
    turn_back = jnp.concatenate([jnp.zeros_like(tau[:3]), -tau[3:]])
    return jnp.concatenate([transform_point(turn_back, -tau[:3]), turn_back[3:]])


def compose(outer: Float[AnyArray, "7"], inner: Float[AnyArray, "7"]) -> Float[Array, "7"]:
    """The parameters of `inner` followed by `outer`: X' = outer(inner(X))."""
    rotation = quaternion_multiply(
        quaternion_from_rotation_vector(outer[3:6]), quaternion_from_rotation_vector(inner[3:6])
    )
    return jnp.concatenate(
        [
            transform_point(outer, inner[:3]),
            rotation_vector_from_quaternion(rotation),
            outer[6:] + inner[6:],
        ]
    )


def displacement(tau: Float[AnyArray, "7"], X: Float[AnyArray, "3"]) -> Float[Array, "3"]:
    """How X moves, to first order: t + ω×X + s·X, in the object unit."""
    return jnp.asarray(tau[:3]) + jnp.cross(tau[3:6], X) + tau[6] * X


@traced_once
def helmert_point(X: Float[AnyArray, "3"]) -> Float[Array, "3 7"]:
    """The rows of the Helmert matrix of a point, ∂X'/∂τ = [I, −[X]×, X] at τ = 0.

    Columns in the order of τ: per object unit, per radian, per unit of log scale.
    """
    # Of the displacement to first order, whose derivative at τ = 0 is that of the transformation.
    return jax.jacfwd(displacement)(jnp.zeros(7, X.dtype), X)


def helmert_pose(X0: Float[AnyArray, "3"], q: Float[AnyArray, "4"]) -> Float[Array, "6 7"]:
    """The rows of the Helmert matrix of a pose, ∂(δX0, δθ)/∂τ at τ = 0.

    δX0 in the object unit; δθ in radians in the camera frame, as in `retract_quaternion`: there a
    small turn r of the object is −M·r, because M·exp([r]×)ᵀ = exp([−M·r]×)·M.
    """
    M = matrix_from_quaternion(q)
    change = lambda tau: jnp.concatenate([displacement(tau, X0), -M @ tau[3:6]])
    return jax.jacfwd(change)(jnp.zeros(7, X0.dtype))
