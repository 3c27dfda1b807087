"""Position and attitude against time.

The camera frame is that of frame cameras: x to the right along the line of detectors, y forward,
the camera looks along −z. R = Mᵀ rotates it to the object frame, from the quaternion (w, x, y, z)
or the angles (pitch θ₂, roll θ₁, yaw θ₃) in radians,

    R = Rx(θ₂)·Ry(θ₁)·Rz(θ₃) = (R3(θ₃)·R2(θ₁)·R1(θ₂))ᵀ,

so that pitch, roll, yaw are the ω, φ, κ of a photograph: nose up, right side down, nose left are
positive. Attitudes refer to the object frame, Earth-fixed or local, or to the orbital frame, whose
axes in the object frame are

    x = y × z,   y = z × (V × z)/|…|,   z = P/|P|          right, forward, up

with the position P and its rate V.

Quaternions are interpolated by `slerp`, qᵢ∘exp(τ·log(qᵢ*∘qᵢ₊₁)), a rotation about a fixed axis at a
constant rate (Shoemake, 1985), or as four numbers by a method of `interpolation`, normalised.
"""

from typing import Literal

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxbundle.geometry import (
    matrix_from_omega_phi_kappa,
    matrix_from_quaternion,
    quaternion_conjugate,
    quaternion_from_rotation_vector,
    quaternion_multiply,
    rotation_vector_from_quaternion,
)
from jaxbundle.pushbroom.interpolation import (
    TimeTable,
    convert_to_pieces,
    covers,
    fraction,
    interpolate,
    interval,
    rate,
)
from jaxbundle.types import AnyArray, Scalar


class AttitudeTable(eqx.Module):
    """Quaternions or angles against time; `slerp` overrides the method of the table.

    `reference`: `"earth"`, R leads to the frame of the positions; `"orbit"`, to the orbital frame.
    """

    table: TimeTable
    slerp: bool = eqx.field(static=True, default=False)
    reference: Literal["earth", "orbit"] = eqx.field(static=True, default="earth")


class Trajectory(eqx.Module):
    """Positions in metres and attitudes."""

    position: TimeTable
    attitude: AttitudeTable


def position_at(trajectory: Trajectory, t: Scalar) -> Float[Array, "3"]:
    """The projection centre P at t, metres; NaN outside the table."""
    return interpolate(trajectory.position, t)


def velocity_at(trajectory: Trajectory, t: Scalar) -> Float[Array, "3"]:
    """The rate V of the interpolated position in the (rotating) object frame, metres per second."""
    return rate(trajectory.position, t)


def rotation_at(trajectory: Trajectory, t: Scalar) -> Float[Array, "3 3"]:
    """R from the camera frame to the object frame at t; NaN outside the table."""
    R = attitude_at(trajectory.attitude, t)
    if trajectory.attitude.reference == "earth":
        return R
    return orbital_frame(position_at(trajectory, t), velocity_at(trajectory, t)) @ R


def attitude_at(attitude: AttitudeTable, t: Scalar) -> Float[Array, "3 3"]:
    """R from the camera frame to the frame the attitudes refer to."""
    table = attitude.table
    if table.values.shape[1] == 3:
        return matrix_from_pitch_roll_yaw(interpolate(table, t))
    return matrix_from_quaternion(_slerp(table, t) if attitude.slerp else interpolate(table, t))


def trajectory_in_pieces(trajectory: Trajectory) -> Trajectory:
    """A trajectory with its tables in pieces (`interpolation.convert_to_pieces`), whatever their
    methods: exact, and of `slerp` to 4e-12 for steps of 60°."""
    position, attitude = trajectory.position, trajectory.attitude
    method = _slerp if attitude.slerp else interpolate
    turned = lambda t: method(attitude.table, t)
    return Trajectory(
        convert_to_pieces(position, lambda t: interpolate(position, t)),
        AttitudeTable(convert_to_pieces(attitude.table, turned), False, attitude.reference),
    )


def matrix_from_pitch_roll_yaw(angles: Float[AnyArray, "3"]) -> Float[Array, "3 3"]:
    """R = Rx(θ₂)·Ry(θ₁)·Rz(θ₃) of (θ₂, θ₁, θ₃) = (pitch, roll, yaw), radians."""
    return matrix_from_omega_phi_kappa(angles).T


def orbital_frame(P: Float[AnyArray, "3"], V: Float[AnyArray, "3"]) -> Float[Array, "3 3"]:
    """The axes right, forward and up at P, of a platform that moves with V, as columns."""
    up = P / jnp.linalg.norm(P)
    # V is not quite horizontal: right and forward are perpendicular to the vertical
    right = jnp.cross(V, up)
    right = right / jnp.linalg.norm(right)
    return jnp.stack([right, jnp.cross(up, right), up], axis=1)


def _slerp(table: TimeTable, t: Scalar) -> Float[Array, "4"]:
    """qᵢ∘exp(τ·log(qᵢ*∘qᵢ₊₁)); NaN outside the table and in gaps."""
    i = interval(table, t)
    start, end = table.values[i], table.values[i + 1]
    turn = rotation_vector_from_quaternion(quaternion_multiply(quaternion_conjugate(start), end))
    part = quaternion_from_rotation_vector(fraction(table, i, t) * turn)
    return jnp.where(covers(table, i, t), quaternion_multiply(start, part), jnp.nan)
