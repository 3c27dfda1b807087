"""Errors of ancillary data: bias, drift, and white noise of every row, in attitude and position.

An erroneous attitude is R·exp([ε]×), ε in radians about right, forward and up (pitch, roll, yaw);
an erroneous position is P + ε in metres. Over time,

    ε(t) = bias + drift·(t − t₀) + interpolated noise of the rows,

t₀ the time of the middle line. `Errors` are values (drawn, or zero to be differentiated by),
`Noise` their standard deviations, common or per axis.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxbundle.geometry import (
    matrix_from_omega_phi_kappa,
    omega_phi_kappa_near,
    quaternion_from_rotation_vector,
    quaternion_multiply,
)
from jaxbundle.geometry.quaternions import matrix_from_rotation_vector
from jaxbundle.pushbroom.image import PushbroomImage
from jaxbundle.types import AnyArray

Sigma = float | Float[np.ndarray, "3"]


class Noise(NamedTuple):
    """Standard deviations: radians and metres, drifts per second, independent rows."""

    attitude_bias: Sigma = 0.0
    attitude_drift: Sigma = 0.0
    attitude_white: Sigma = 0.0
    position_bias: Sigma = 0.0
    position_drift: Sigma = 0.0
    position_white: Sigma = 0.0


class Errors(NamedTuple):
    """Errors of an image's ancillary data, in the order of `Noise`; no rows [0, 3]:
    none in the rows."""

    attitude_bias: Float[AnyArray, "3"]
    attitude_drift: Float[AnyArray, "3"]
    attitude_white: Float[AnyArray, "rows 3"]
    position_bias: Float[AnyArray, "3"]
    position_drift: Float[AnyArray, "3"]
    position_white: Float[AnyArray, "rows2 3"]


def zero_errors(image: PushbroomImage) -> Errors:
    """Errors that are all zero."""
    rows = [len(t.times) for t in (image.trajectory.attitude.table, image.trajectory.position)]
    shapes = [(3,), (3,), (rows[0], 3), (3,), (3,), (rows[1], 3)]
    return Errors(*(jnp.zeros(shape) for shape in shapes))


def sigmas(image: PushbroomImage, noise: Noise) -> Errors:
    """The standard deviation of every single error."""
    return Errors(
        *(
            np.broadcast_to(np.asarray(sigma, float), zero.shape)
            for sigma, zero in zip(noise, zero_errors(image))
        )
    )


def draw(sigma: Errors, key: AnyArray) -> Errors:
    """Normally distributed errors of these standard deviations (`sigmas`)."""
    keys = jax.random.split(key, len(sigma))
    return Errors(*(s * jax.random.normal(k, s.shape) for s, k in zip(sigma, keys)))


def add_errors(image: PushbroomImage, errors: Errors) -> PushbroomImage:
    """The image with these errors in its trajectory; differentiable in them.

    **Raises:** `ValueError` for errors of the rows of a table in pieces, which no longer has
    them."""
    attitude, position = image.trajectory.attitude.table, image.trajectory.position
    for table, white in ((attitude, errors.attitude_white), (position, errors.position_white)):
        # `pieces` replace the rows (`interpolation`): errors of these would have no effect
        if len(white) and table.pieces is not None:
            raise ValueError("a table in pieces has no rows that errors could be added to")
    rotate_quaternion = lambda q, error: quaternion_multiply(
        q, quaternion_from_rotation_vector(error)
    )
    turn = _rotate_angles if attitude.values.shape[1] == 3 else rotate_quaternion
    offsets = image.offsets
    return eqx.tree_at(
        lambda i: (
            i.trajectory.attitude.table.values,
            i.trajectory.position.values,
            i.offsets.attitude,
            i.offsets.attitude_rate,
            i.offsets.position,
            i.offsets.position_rate,
        ),
        image,
        (
            jax.vmap(turn)(attitude.values, errors.attitude_white)
            if len(errors.attitude_white)
            else attitude.values,
            position.values + errors.position_white
            if len(errors.position_white)
            else position.values,
            offsets.attitude + errors.attitude_bias,
            offsets.attitude_rate + errors.attitude_drift,
            offsets.position + errors.position_bias,
            offsets.position_rate + errors.position_drift,
        ),
    )


def _rotate_angles(angles: Float[AnyArray, "3"], error: Float[AnyArray, "3"]) -> Float[Array, "3"]:
    """The angles of R·exp([ε]×), nearest to the given ones."""
    # Angles give Rᵀ, and (R·exp([ε]×))ᵀ = exp([ε]×)ᵀ·Rᵀ.
    M = matrix_from_rotation_vector(error).T @ matrix_from_omega_phi_kappa(angles)
    return omega_phi_kappa_near(M, angles)
