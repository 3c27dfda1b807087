"""Small refinements that the tests share: a satellite that looks at points of known height."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxbundle.geometry.ellipsoid import WGS84, earth_fixed, geodetic
from jaxbundle.network.tables import Observations
from jaxbundle.pushbroom.ancillary import attitude_table, position_table
from jaxbundle.pushbroom.frames import circular_orbit
from jaxbundle.pushbroom.image import make_image
from jaxbundle.pushbroom.locate import locate_points
from jaxbundle.pushbroom.scanner import FocalLine, LineTimes
from jaxbundle.pushbroom.surfaces import Height
from jaxbundle.pushbroom.trajectory import Trajectory, matrix_from_pitch_roll_yaw
from jaxbundle.refinement.freedom import Change, Form, changed
from jaxbundle.refinement.tables import GroundPoints, ScannerImage

LINES, PIXELS, PERIOD = 900, 800, 1 / 300
"""3 s, about 23 m a line."""
ARCSEC = np.radians(1 / 3600)


def satellite(pitch=0.0, roll=0.0, start=0.0):
    """An image from 505 km with 20 m pixels and constant attitude, from `start` s of the orbit."""
    t = np.arange(-4.0, 8.0)
    P, V = circular_orbit(t + start, 505e3, np.radians(97.4), 1.9, 0.1)
    rows = np.tile([pitch, roll, 0.0], (4, 1))
    return make_image(
        Trajectory(
            position_table(t, P, V, method="hermite"),
            attitude_table(np.array([-1.0, 1.0, 3.0, 5.0]), rows, method="linear", gap=9.0,
                           reference="orbit"),
        ),
        LineTimes(jnp.float64(0.0), jnp.float64(PERIOD)),
        FocalLine(jnp.array([700.0] + 10 * [0.0]), jnp.float64(0.028),
                  jnp.float64((PIXELS - 1) / 2), jnp.float64(0.0)),
        LINES, PIXELS,
    )  # fmt: skip


@eqx.filter_jit
def seen(image, truth, heights, lines, pixels):
    """The ground points that places in the true image show; `truth` changes (image, t)."""

    def one(h, line, pixel):
        moved = truth(image, image.times.time(line))
        return locate_points(moved, Height(h, WGS84), line[None], pixel[None])[:, 0]

    return jax.vmap(one)(heights, lines, pixels)
