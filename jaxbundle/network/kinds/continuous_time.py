"""Image points of cameras that are not synchronised: the target moves along a spline in time.

    τ = t + offset + rate·(t − t_m) + read-out·line        the time by the clock of the reference
    Y = p(τ) + M(τ)ᵀ·X'                                    in the frame of the reference camera
    ray = R_k·(Y − b_k)                                    as of any camera on a mounting

t is the time of a photograph by the clock of its own camera, t_m the middle of all of that camera,
so that offset and rate correlate little; `line` is the measured row relative to the middle one, in
heights of the image: of a rolling shutter the read-out time is a third unknown of the clock. p and
M are a spline (`jaxbundle.geometry.pose_splines`): its control poses are rows of the table
`trajectory`, of which an observation touches four, those of the interval of knots in which it was
when the problem was made. If the clock moves it beyond a knot, the cubic of its interval goes on:
at the knot it agrees with the next one to the second derivative.

A motion leaves an offset open if its twist (velocity and angular velocity) in the frame of the
reference camera does not change: exp(ξ·(τ + offset)) = exp(ξ·offset)·exp(ξ·τ) is another mounting.
"""

import dataclasses
from collections.abc import Sequence
from typing import Any, NamedTuple

from jaxbundle import cameras
from jaxbundle.geometry.pose_splines import (
    compose_gibbs,
    gibbs_vector,
    spline_position,
    turn_back_by_steps,
)
from jaxbundle.leastsquares.declarations import Kind
from jaxbundle.leastsquares.spaces import Change, Posed, Triple, Turned
from jaxbundle.types import Scalar

TRAJECTORY, CLOCK = "trajectory", "clock"
# The unknowns of a clock: seconds, without unit, seconds.
OFFSET, RATE, READ_OUT = CLOCK_PARAMETERS = ("offset", "rate", "read-out")


class Instant(NamedTuple):
    """When a point was exposed: `since` the first knot of its interval, as its own clock says;
    `from_middle`: t − t_m; seconds; `line`: heights of the image; `frequency`: 1/Δ of the knots."""

    since: Any
    from_middle: Any
    line: Any
    frequency: Any

    def place(self, clock: Change) -> Scalar:
        """u, 0 to 1 within the interval of knots."""
        offset, rate, read_out = clock
        time = self.since + offset + rate * self.from_middle + read_out * self.line
        return time * self.frequency


def place_on_spline(controls: Sequence[Posed], u: Scalar, X: Triple) -> Triple:
    """p + Mᵀ·X at a place u between the knots."""
    position = spline_position([control.centre for control in controls], u)
    # M(t)ᵀ·X = M_iᵀ·(M_i·M(t)ᵀ·X): only steps between controls have parts of the basis
    rotations = [control.rotation for control in controls]
    turned = turn_back_by_steps([_step(*pair) for pair in zip(rotations, rotations[1:])], u, X)
    return tuple(a + b for a, b in zip(position, rotations[0].apply_inverse(turned)))


def _step(start: Turned, end: Turned) -> Triple:
    """The Gibbs vector of the rotation from one to the other; of the small rotations that both
    have besides, θ/2 to second order."""
    h = gibbs_vector(end.rows, start.rows)
    if end.turn is not None:
        h = compose_gibbs(tuple(t / 2 for t in end.turn), h)
    if start.turn is not None:
        h = compose_gibbs(h, tuple(-t / 2 for t in start.turn))
    return h


@dataclasses.dataclass(frozen=True)
class TimedImagePoint:
    """The two residuals of an image point of a target on a spline, in the unit of the camera model;
    a pose may lead from the board to its body before."""

    model: str | cameras.CameraModel
    domain: str

    def __call__(self, *blocks_and_measured: Any) -> Change:
        *poses, clock, mounting, interior, ray, (xy, instant) = blocks_and_measured
        board, controls = poses[:-4], poses[-4:]
        for pose in board:
            ray = pose.ray(ray)
        ray = mounting.ray(place_on_spline(controls, instant.place(clock), ray))
        return cameras.residual(cameras.get_model(self.model), self.domain, interior, ray, xy)


def timed_image_points(
    model: str | cameras.CameraModel,
    domain: str,
    camera: str,
    mounting: str,
    board: str | None = None,
) -> Kind:
    """Image points of the cameras of one model, whose table is `camera`, on a `mounting`, of a
    target that moves along a spline; `board`: the table of boards on bodies. Measured are x, y and
    the `Instant`."""
    boards = () if board is None else (board,)
    tables = (*boards, *[TRAJECTORY] * 4, CLOCK, mounting, camera, "point")
    name = "image coordinates"
    if camera != "camera":
        name += f" of {cameras.get_model(model).name}"
    residual = TimedImagePoint(model, domain)
    return Kind(name, residual, tables, ("x", "y"), "image", scalars=True, invariant=True)
