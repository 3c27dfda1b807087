"""A pushbroom image: every line is a one-row photograph with its own exterior orientation.

    X = P(t) + s·R(t)·[ξ, η, −1],      t = t(l),   (ξ, η) = optics(u)
    R(t) = R_attitude(t)·exp([a + ȧ·(t − t₀)]×)·R_mounting,      P(t) = P_table(t) + p + ṗ·(t − t₀)

`Offsets` a, ȧ, p, ṗ (about the time t₀ of the middle line) are zero unless they are estimated or
propagated; a rotates about right, forward and up: pitch, roll and yaw.
"""

from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxbundle.errors import InputError
from jaxbundle.float64 import require_x64
from jaxbundle.geometry import matrix_from_rotation_vector
from jaxbundle.network.tables import Source
from jaxbundle.pushbroom.ancillary import ATTITUDE, POSITIONS, check_covered
from jaxbundle.pushbroom.corrections import Corrections
from jaxbundle.pushbroom.scanner import LineTimes, Optics
from jaxbundle.pushbroom.trajectory import (
    Trajectory,
    matrix_from_pitch_roll_yaw,
    position_at,
    rotation_at,
    velocity_at,
)
from jaxbundle.types import AnyArray, Numbers, Scalar


class Offsets(eqx.Module):
    """Small changes of the trajectory: radians, metres, and their rates per second."""

    attitude: Float[AnyArray, "3"]
    attitude_rate: Float[AnyArray, "3"]
    position: Float[AnyArray, "3"]
    position_rate: Float[AnyArray, "3"]


def no_offsets() -> Offsets:
    """The trajectory from its tables."""
    return Offsets(*(jnp.zeros(3) for _ in range(4)))


class PushbroomImage(eqx.Module):
    """Trajectory, line times, optics, mounting and corrections of an image.

    `mounting`: pitch, roll, yaw in radians of the camera in the frame whose attitude is given;
    `lines`, `pixels`: its size. All arrays are parameters: replace them by `equinox.tree_at`,
    differentiate by them.
    """

    trajectory: Trajectory
    times: LineTimes
    optics: Optics
    mounting: Float[AnyArray, "3"]
    offsets: Offsets
    corrections: Corrections = eqx.field(static=True)
    lines: int = eqx.field(static=True)
    pixels: int = eqx.field(static=True)

    @property
    def middle_time(self) -> Scalar:
        """The time of the middle line, in seconds."""
        return self.times.time((self.lines - 1) / 2)


class LinePose(NamedTuple):
    """Exterior orientation of a line: P in metres, R camera → object, rate V of P in m/s."""

    P: Float[AnyArray, "3"]
    R: Float[AnyArray, "3 3"]
    V: Float[AnyArray, "3"]


def make_image(
    trajectory: Trajectory,
    times: LineTimes,
    optics: Optics,
    lines: int,
    pixels: int,
    mounting: Numbers | Float[AnyArray, "3"] | None = None,
    corrections: Corrections = Corrections(),  # noqa: B008
    sources: tuple[Source, Source] = (POSITIONS, ATTITUDE),
) -> PushbroomImage:
    """An image whose tables cover all its lines.

    **Arguments:** `sources` name the tables of positions and attitude in messages.

    **Raises:** `InputError` that names the line at a time outside a table or in a gap; for an
    impossible size.
    """
    require_x64()
    check_size(lines, pixels, "image")
    mounting = jnp.zeros(3) if mounting is None else jnp.asarray(mounting, float)
    image = PushbroomImage(
        trajectory, times, optics, mounting, no_offsets(), corrections, int(lines), int(pixels)
    )
    line_times = np.asarray(times.time(jnp.arange(lines, dtype=float)))
    for table, source in zip((trajectory.position, trajectory.attitude.table), sources):
        check_covered(table, line_times, source)
    return image


def check_size(lines: float, pixels: float, where: str) -> None:
    """Refuse an image size that is not integer, without lines, with fewer than 2 pixels, or
    impossibly large."""
    # Ten million lines are 7000 km of pixels of 0.7 m: more is a slip of the pen.
    largest = 10_000_000
    for size, name, smallest in ((lines, "lines", 1), (pixels, "pixels", 2)):
        if not smallest <= size <= largest or size != int(size):
            raise InputError(
                f"{where}: {size:.15g} {name}; a whole number from {smallest} to {largest} is "
                "expected"
            )


def pose_at(image: PushbroomImage, t: Scalar) -> LinePose:
    """The pose at the time t, in seconds; NaN outside the tables."""
    return move_pose(recorded_pose(image, t), t - image.middle_time, image.offsets, image.mounting)


def recorded_pose(image: PushbroomImage, t: Scalar) -> LinePose:
    """The pose of the platform from its tables, without offsets and mounting."""
    trajectory = image.trajectory
    return LinePose(
        position_at(trajectory, t), rotation_at(trajectory, t), velocity_at(trajectory, t)
    )


def move_pose(
    platform: LinePose, dt: Scalar, offsets: Offsets, mounting: Float[AnyArray, "3"]
) -> LinePose:
    """The pose of the camera on this pose of its platform, `dt` seconds after the middle line."""
    turn = matrix_from_rotation_vector(offsets.attitude + dt * offsets.attitude_rate)
    R = platform.R @ turn @ matrix_from_pitch_roll_yaw(mounting)
    P = platform.P + offsets.position + dt * offsets.position_rate
    return LinePose(P, R, platform.V + offsets.position_rate)
