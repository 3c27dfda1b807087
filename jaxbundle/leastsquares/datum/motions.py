"""Motions that observations may leave open: shifts, and similarities of points and poses.

A motion that keeps a point fixed to first order also keeps it as a finite motion: shift, rotation
and scale act simultaneously over a unit of time, not in sequence (canonical coordinates).
"""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxbundle.geometry import transform_point, transform_pose
from jaxbundle.geometry.quaternions import turn_object_slightly
from jaxbundle.geometry.similarity import displacement
from jaxbundle.leastsquares.declarations import Motions, Table
from jaxbundle.leastsquares.spaces import Pose, PoseValue, Vector
from jaxbundle.types import AnyArray

SIMILARITY_PARAMETERS = (
    "shift X",
    "shift Y",
    "shift Z",
    "rotation X",
    "rotation Y",
    "rotation Z",
    "scale",
)
ROTATION, SCALE = slice(3, 6), slice(6, 7)


# For integrals from −1 to 1.
NODES, WEIGHTS = np.polynomial.legendre.leggauss(20)


def similarity(points: Sequence[str] = ("point",), poses: Sequence[str] = ()) -> Motions:
    """The seven similarity parameters of space, for tables of points [n, 3] and of poses."""
    actions = [(name, _move_point) for name in points] + [(name, move_pose) for name in poses]
    return Motions(SIMILARITY_PARAMETERS, tuple(actions), curved=(3, 4, 5, 6))


def similarity_of_plane(points: Sequence[str]) -> Motions:
    """Two shifts, a rotation and a scale, for tables of points [n, 2]."""
    names = ("shift X", "shift Y", "rotation", "scale")
    return Motions(names, tuple((name, _move_in_plane) for name in points), curved=(2, 3))


def shift(table: str) -> Motions:
    """One constant for all rows of a table of numbers, such as the level of heights."""
    return Motions(("shift",), ((table, _shift),))


def likely_motions(tables: Sequence[Table]) -> Motions | None:
    """The default: a similarity of all tables of three coordinates and poses, else of two
    coordinates, else a shift of the first table of numbers."""
    vectors = {n: [t.name for t in tables if t.space == Vector(n)] for n in (0, 2, 3)}
    poses = [t.name for t in tables if isinstance(t.space, Pose)]
    if poses or vectors[3]:
        return similarity(vectors[3], poses)
    if vectors[2]:
        return similarity_of_plane(vectors[2])
    return shift(vectors[0][0]) if vectors[0] else None


@dataclasses.dataclass(frozen=True)
class JointMotion:
    """`move(motion, value)` of motions whose shift follows rotation and scale, for simultaneous
    motions; `near`: the same to first order, for the directions of the motions;
    `transform(motion, place)` for the shifts, which are the first `size` numbers."""

    move: Callable
    near: Callable
    transform: Callable
    size: int

    def __call__(self, motion: Float[Array, " motions"], value: Any) -> Any:
        return self.move(move_at_once(self.transform, motion, self.size), value)


def _transform_pose(motion: Float[Array, " motions"], value: PoseValue) -> PoseValue:
    return PoseValue(*transform_pose(motion, *value))


def _displace_point(
    motion: Float[Array, " motions"], value: Float[AnyArray, " 3"]
) -> Float[AnyArray, " 3"]:
    return value + displacement(motion, value)


def _displace_pose(motion: Float[Array, " motions"], value: PoseValue) -> PoseValue:
    position = _displace_point(motion, value.position)
    return PoseValue(position, turn_object_slightly(value.rotation, motion[3:6]))


def _transform_in_plane(
    motion: Float[Array, " motions"], value: Float[Array, " 2"]
) -> Float[Array, " 2"]:
    x, y, turn, log_scale = motion
    c, s = jnp.exp(log_scale) * jnp.cos(turn), jnp.exp(log_scale) * jnp.sin(turn)
    return jnp.stack([c * value[0] - s * value[1] + x, s * value[0] + c * value[1] + y])


_move_point = JointMotion(transform_point, _displace_point, transform_point, 3)
# A pose, or a frame, that moves with space.
move_pose = JointMotion(_transform_pose, _displace_pose, transform_point, 3)
_move_in_plane = JointMotion(_transform_in_plane, _transform_in_plane, _transform_in_plane, 2)


def move_at_once(
    transform: Callable, motion: Float[Array, " motions"], size: int
) -> Float[Array, " motions"]:
    """The motion with shift after rotation and scale that equals a simultaneous one: ∫₀¹ A(u)·t du,
    A(u) the rotation and scale after the time u (Gauss–Legendre, to rounding up to two turns and a
    scale of e⁵)."""
    # A shift per unit of time, rotated and scaled by what has happened until then.
    without_shift = motion.at[:size].set(0.0)
    shifts = jax.vmap(lambda u: transform(u * without_shift, motion[:size]))((NODES + 1) / 2)
    return without_shift.at[:size].set(WEIGHTS / 2 @ shifts)


def scale_length(motion: Float[Array, "7"], value: Float[AnyArray, "*n"]) -> Float[Array, "*n"]:
    """Lengths after a similarity of object space."""
    return jnp.exp(motion[6]) * value


def scale_position(motion: Float[Array, "7"], value: PoseValue) -> PoseValue:
    """A pose relative to a frame that moves with space, such as a mounting: its position is a
    length."""
    return PoseValue(scale_length(motion, value.position), value.rotation)


def _shift(motion: Float[Array, " motions"], value: Float[Array, ""]) -> Float[Array, ""]:
    return value + motion[0]
