"""Small pushbroom images that the tests share: a satellite, and a camera above a plane."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from scipy.spatial.transform import Rotation

from jaxbundle.geometry import ellipsoid as el
from jaxbundle.pushbroom.ancillary import attitude_table, position_table
from jaxbundle.pushbroom.corrections import Corrections
from jaxbundle.pushbroom.earth_frames import circular_orbit
from jaxbundle.pushbroom.image import make_image
from jaxbundle.pushbroom.image_to_ground import locate_lines
from jaxbundle.pushbroom.scanner import FocalLine, LineTimes
from jaxbundle.pushbroom.trajectory import Trajectory, orbital_frame

LINES, PIXELS = 600, 400
HEIGHT = 505e3
PERIOD = 1 / 150
"""Seconds a line: 4 s in all, some 40 m a line."""
PLACE = (505e3, np.radians(97.4), 1.9, 0.1)

locate = jax.jit(locate_lines)
frames = jax.jit(jax.vmap(orbital_frame))
geodetic = jax.jit(partial(el.geodetic, el.WGS84))


def wobble(t, size=1e-4):
    """Pitch, roll, yaw of a restless satellite, radians."""
    t = np.asarray(t)
    return size * np.stack(
        [np.sin(2 * np.pi * 0.7 * t), 20 + np.cos(2 * np.pi * 0.4 * t), np.sin(1.3 * t)], -1
    )


def orbit(t):
    return circular_orbit(np.asarray(t), *PLACE)


def attitude(t):
    """Rotations camera → Earth-fixed."""
    frame = np.asarray(frames(*orbit(t)))
    return Rotation.from_matrix(frame) * Rotation.from_euler("XYZ", wobble(t))


def quaternions(t):
    return np.roll(attitude(t).as_quat(), 1, axis=1)


def focal_line(c=700.0, **parameters):
    """A line of 0.05 mm detectors, slightly ahead of the axis, behind a lens with distortion."""
    names = ("c", "x0", "y0", "K1", "K2", "K3", "P1", "P2", "b1", "b2", "r0")
    given = {"c": c, "x0": 0.02, "K1": 2e-6, "P1": 1e-6} | parameters
    return FocalLine(
        jnp.array([given.get(name, 0.0) for name in names]), jnp.float64(0.05),
        jnp.float64((PIXELS - 1) / 2), jnp.float64(0.3),
    )  # fmt: skip


def satellite(
    position="lagrange", turns="slerp", rate=10.0, optics=None, corrections=Corrections(),  # noqa: B008
    times=None,
):  # fmt: skip
    """An image from 505 km: positions every second, attitudes at `rate` Hz."""
    t = np.arange(-6.0, 11.0)
    table = position_table(t, *orbit(t), method=position)
    t = np.arange(-1, 5.5, 1 / rate)
    if turns == "angles":
        rows = attitude_table(t, wobble(t), method="spline", reference="orbit")
    else:
        rows = attitude_table(t, quaternions(t), method=turns)
    times = LineTimes(jnp.float64(0.0), jnp.float64(PERIOD)) if times is None else times
    return make_image(
        Trajectory(table, rows), times, focal_line() if optics is None else optics, LINES, PIXELS,
        mounting=[0.01, -0.02, 0.3], corrections=corrections,
    )  # fmt: skip


def above_a_plane(angles=(0.0, 0.0, 0.0), speed=50.0, height=1000.0, c=120.0):
    """A camera that flies north (+Y) at 1000 m, two rows of a table, seconds as long as needed."""
    t = np.array([-1.0, 100.0])
    P = np.stack([0 * t, speed * t, height + 0 * t], 1)
    return make_image(
        Trajectory(
            position_table(t, P, method="linear"),
            attitude_table(t, np.tile(angles, (2, 1)), method="linear"),
        ),
        LineTimes(jnp.float64(0.0), jnp.float64(0.01)), focal_line(c, x0=0.0, K1=0.0, P1=0.0),
        LINES, PIXELS,
    )  # fmt: skip
