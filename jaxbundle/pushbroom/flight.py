"""Simulation: a true trajectory, its records by instruments, and the image.

The true angles are sums of signals (`signals`) on a circular orbit about the rotating Earth, from
one place above the Earth to another, or on a straight line above a plane. Instruments sample
position and attitude at their rates, with errors (`noise`). The image processing uses only these
samples: its trajectory is interpolated from them. Without errors only the interpolation error
remains.
"""

import dataclasses
from collections.abc import Callable, Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxbundle.choices import Resampling
from jaxbundle.errors import InputError
from jaxbundle.pushbroom.ancillary import attitude_table, position_table
from jaxbundle.pushbroom.earth_frames import circular_orbit
from jaxbundle.pushbroom.image import PushbroomImage, make_image
from jaxbundle.pushbroom.image_to_ground import locate_lines
from jaxbundle.pushbroom.interpolation import TimeTable
from jaxbundle.pushbroom.noise import Errors, Noise, add_errors, draw, sigmas
from jaxbundle.pushbroom.orbit import state_orbit
from jaxbundle.pushbroom.resampling import resample
from jaxbundle.pushbroom.scanner import LineTimes, Optics
from jaxbundle.pushbroom.signals import signal
from jaxbundle.pushbroom.surfaces import GroundSurface
from jaxbundle.pushbroom.trajectory import AttitudeTable, Trajectory
from jaxbundle.system.programs import compile_once
from jaxbundle.types import AnyArray


@dataclasses.dataclass(frozen=True)
class Flight:
    """A simulated flight; angles in radians, lengths in metres, times in seconds.

    - `lines`, `pixels`, `period`, `optics`, `mounting`: the scanner.
    - `track`: `{"height", "inclination", "node", "argument"}` of a circular orbit, or
      `{"state", "at", "j2"}` of one Earth-fixed state vector (`orbit`), or
      `{"start", "velocity"}` or `{"start", "end"}` of a straight line in a local frame, or
      `{"start", "end", "centre"}`, Earth-fixed, of an arc about the centre of the Earth; the ends
      are those of the first and the last line.
    - `angles`: signals of pitch, roll, yaw, in the orbital frame or the local one.
    - `position_rate`, `attitude_rate`: of the instruments, in Hz; `noise`: their errors.
    - `position_interpolation`, `attitude_interpolation`: of the samples.
    - `seed`: of all random numbers.
    """

    lines: int
    pixels: int
    period: float
    optics: Optics
    track: Mapping[str, Any]
    angles: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    mounting: tuple[float, float, float] = (0.0, 0.0, 0.0)
    position_rate: float = 2.0
    attitude_rate: float = 4.0
    position_interpolation: str = "lagrange"
    attitude_interpolation: str = "spline"
    noise: Noise = Noise()  # noqa: RUF009
    seed: int = 0


def true_image(flight: Flight) -> PushbroomImage:
    """The image with the true trajectory."""
    # So dense that its own interpolation is not seen beside that of the instrument's rows: the
    # error of a spline falls with the fourth power of the step, here to 1/600. On a low orbit two
    # rows a second leave r·(ω·h)⁸ by Lagrange's polynomial of degree 7, less than rounding.
    rate = max(20.0, 5 * flight.attitude_rate)
    return _image(flight, _position(flight, 2.0, "lagrange"), _attitude(flight, rate, "spline"))


def measured_image(flight: Flight) -> PushbroomImage:
    """The image with the trajectory recorded by its instruments: sampled, with noise."""
    image = _image(
        flight,
        _position(flight, flight.position_rate, flight.position_interpolation),
        _attitude(flight, flight.attitude_rate, flight.attitude_interpolation),
    )
    if not any(np.any(sigma) for sigma in flight.noise):
        return image
    return _measure(image, sigmas(image, flight.noise), jax.random.key(flight.seed))


def with_errors_in_rows(image: PushbroomImage, errors: Errors) -> PushbroomImage:
    """Like `add_errors`, with bias and drift in the rows of the tables, as written by
    instruments."""
    # The rows of `add_errors` can hold all of it: bias and drift are linear in time. The difference
    # is what the interpolation makes of them, which acts on written rows.
    t0 = image.middle_time

    def rows(
        table: TimeTable,
        bias: Float[AnyArray, "3"],
        drift: Float[AnyArray, "3"],
        white: Float[AnyArray, "rows 3"],
    ) -> Float[AnyArray, "rows 3"]:
        return white + bias + (table.times[:, None] - t0) * drift

    zero = jax.tree.map(jnp.zeros_like, errors)
    attitude, position = image.trajectory.attitude.table, image.trajectory.position
    return add_errors(
        image,
        zero._replace(
            attitude_white=rows(
                attitude, errors.attitude_bias, errors.attitude_drift, errors.attitude_white
            ),
            position_white=rows(
                position, errors.position_bias, errors.position_drift, errors.position_white
            ),
        ),
    )


_measure = compile_once(lambda image, sigma, key: with_errors_in_rows(image, draw(sigma, key)), ())


def take_image(
    image: PushbroomImage,
    surface: GroundSurface,
    scene: Float[AnyArray, "bands rows columns"],
    to_scene: Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]],
    lines: Float[np.ndarray, " lines"],
    resampling: Resampling = "bilinear",
    pixels: Float[np.ndarray, " pixels"] | None = None,
) -> Float[np.ndarray, "bands lines pixels"]:
    """Lines of the image of a scene; NaN outside the scene.

    **Arguments:** `to_scene(X)` gives row and column in the scene of points X [3, lines, pixels];
    `pixels` of the lines, all by default.
    """
    if pixels is None:
        pixels = np.arange(image.pixels, dtype=float)
    X = np.asarray(_ground(image, surface, lines, pixels))
    row, column = to_scene(X)
    return np.asarray(_resample(scene, row, column, resampling))


_ground = compile_once(locate_lines, ())
_resample = compile_once(resample, 3)


def _image(flight: Flight, position: TimeTable, attitude: AttitudeTable) -> PushbroomImage:
    times = LineTimes(jnp.zeros(()), jnp.asarray(float(flight.period)))
    return make_image(
        Trajectory(position, attitude),
        times,
        flight.optics,
        flight.lines,
        flight.pixels,
        flight.mounting,
    )


def _samples(flight: Flight, rate: float) -> Float[np.ndarray, " rows"]:
    """Times of rows a whole number of steps from the first line, six before it and after the last.

    Lagrange's polynomial of degree 7 takes four on either side; two more keep the edges of the
    image away from the ends of a spline.
    """
    duration, margin = flight.period * (flight.lines - 1), 6
    return np.arange(-margin, np.ceil(duration * rate) + margin + 1) / rate


def _position(flight: Flight, rate: float, method: str) -> TimeTable:
    t, track = _samples(flight, rate), dict(flight.track)
    if "end" in track:
        start, end = (np.asarray(track[k], float) for k in ("start", "end"))
        duration = flight.period * (flight.lines - 1)
        _check_ends(start, end, duration)
        if "centre" in track:
            P, V = arc_between(t, start, end, duration, np.asarray(track["centre"], float))
            return position_table(t, P, V, method=method)
        track["velocity"] = (end - start) / duration
    if "start" in track:
        start, velocity = (np.asarray(track[k], float) for k in ("start", "velocity"))
        return position_table(
            t, start + t[:, None] * velocity, np.tile(velocity, (len(t), 1)), method=method
        )
    if "state" in track:
        state = np.asarray(track.pop("state"), float)
        return position_table(t, *state_orbit(t, state[:3], state[3:], **track), method=method)
    if "height" not in track:
        raise InputError("track: give height, inclination, … of an orbit, or start and velocity")
    P, V = circular_orbit(t, **track)
    return position_table(t, P, V, method=method)


def _attitude(flight: Flight, rate: float, method: str) -> AttitudeTable:
    """The table of angles, sums of signals, each with random numbers of its own."""
    t, angles = _samples(flight, rate), []
    for axis, name in enumerate(("pitch", "roll", "yaw")):
        parts = flight.angles.get(name, 0.0)
        parts = parts if isinstance(parts, list | tuple) else [parts]
        rng = [np.random.default_rng([flight.seed, axis, k]) for k in range(len(parts))]
        try:
            angles.append(sum(signal(part, t, 0.0, r) for part, r in zip(parts, rng)))
        except InputError as error:
            raise InputError(f"{name}: {error}") from None
    local = "start" in flight.track and "centre" not in flight.track
    reference = "earth" if local else "orbit"
    return attitude_table(t, np.stack(angles, 1), method=method, reference=reference)


def arc_between(
    t: Float[np.ndarray, " rows"],
    start: Float[np.ndarray, "3"],
    end: Float[np.ndarray, "3"],
    duration: float,
    centre: Float[np.ndarray, "3"],
) -> tuple[Float[np.ndarray, "rows 3"], Float[np.ndarray, "rows 3"]]:
    """Positions (m) and velocities (m/s) at times t from `start` at 0 to `end` at `duration`.

    The direction from the centre turns at a constant rate in the plane of both, the distance from
    it changes linearly:

        P = C + r·(cos α·u + sin α·w),    r = r₀ + ṙ·t,    α = α̇·t

    with u towards the start and w at a right angle to it, in the plane.

    **Raises:** `InputError` where both are on one line with the centre, which leaves the plane
    open."""
    from_centre = np.stack([start, end]) - centre
    r = np.linalg.norm(from_centre, axis=1)
    u, v = from_centre / r[:, None]
    sine = np.linalg.norm(np.cross(u, v))
    # Below this the direction of w is lost in the rounding of coordinates.
    if sine < 1e-12:
        where = "opposite places of the Earth" if u @ v < 0 else "above one place of the Earth"
        raise InputError(f"track: start and end are {where}, which gives no direction; give others")
    w = (v - (u @ v) * u) / sine
    turn, climb = np.arctan2(sine, u @ v) / duration, (r[1] - r[0]) / duration
    cos, sin = (f(turn * t)[:, None] for f in (np.cos, np.sin))
    distance = (r[0] + climb * t)[:, None]
    outward, forward = cos * u + sin * w, cos * w - sin * u
    return centre + distance * outward, climb * outward + distance * turn * forward


def _check_ends(
    start: Float[np.ndarray, "3"], end: Float[np.ndarray, "3"], duration: float
) -> None:
    """Refuse a track without length, or without time to fly it."""
    if not duration > 0:
        raise InputError("track: start and end need an image of two lines at least")
    if (start == end).all():
        raise InputError("track: start and end are the same place; give two")
