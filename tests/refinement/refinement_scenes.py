"""Small refinements that the tests share: a satellite that looks at points of known height."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxbundle.geometry.ellipsoid import WGS84
from jaxbundle.network.tables import Observations, Source
from jaxbundle.pushbroom.ancillary import attitude_table, position_table
from jaxbundle.pushbroom.corrections import Corrections
from jaxbundle.pushbroom.earth_frames import circular_orbit
from jaxbundle.pushbroom.image import make_image
from jaxbundle.pushbroom.image_to_ground import locate_point
from jaxbundle.pushbroom.scanner import FocalLine, LineTimes
from jaxbundle.pushbroom.surfaces import Height
from jaxbundle.pushbroom.trajectory import Trajectory
from jaxbundle.refinement import FREE, Freedom, ScannerImage, local_points
from jaxbundle.refinement.freedom import change_image, change_of

LINES, PIXELS, PERIOD = 900, 800, 1 / 300
"""3 s, about 23 m a line."""
ARCSEC = np.radians(1 / 3600)
SIGMA = 0.3
"""Of a measured line or pixel."""
COUNT = 40
"""Points of the standard case."""
JITTER = 8 * ARCSEC
FREEDOM = Freedom(
    attitude=FREE, attitude_rate=FREE, jitter=(JITTER, JITTER, 0.0), knot_spacing=0.25
)


def satellite(corrections=Corrections()):  # noqa: B008
    """An image from 505 km with 20 m pixels, level but for a slow roll."""
    t = np.arange(-4.0, 8.0)
    P, V = circular_orbit(t, 505e3, np.radians(97.4), 1.9, 0.1)
    rows = np.outer(np.arange(4), [0.0, 1e-4, 0.0])
    times = np.array([-1.0, 1.0, 3.0, 5.0])
    return make_image(
        Trajectory(
            position_table(t, P, V, method="hermite"),
            attitude_table(times, rows, method="linear", gap=9.0, reference="orbit"),
        ),
        LineTimes(jnp.float64(0.0), jnp.float64(PERIOD)),
        FocalLine(jnp.array([700.0] + 10 * [0.0]), jnp.float64(0.028),
                  jnp.float64((PIXELS - 1) / 2), jnp.float64(0.0)),
        LINES, PIXELS, corrections=corrections,
    )  # fmt: skip


@eqx.filter_jit
def ground(image, form, p, heights, places):
    """The ground points that places show, p the vector of the image's true changes."""

    def one(h, place):
        moved = change_image(image, form, change_of(form.sizes, p), image.times.time(place[0]))
        return jnp.stack(locate_point(moved, Height(h, WGS84), *place))

    return jax.vmap(one)(heights, places)


@eqx.filter_jit
def ground_with_sine(image, bias, drift, amplitude, heights, places):
    """The same with a bias, a drift and a jitter of 1 Hz, radians."""

    def one(h, place):
        t = image.times.time(place[0])
        turn = bias + amplitude * jnp.sin(2 * jnp.pi * t)
        offsets = dataclasses.replace(image.offsets, attitude=turn, attitude_rate=drift)
        return jnp.stack(
            locate_point(dataclasses.replace(image, offsets=offsets), Height(h, WGS84), *place)
        )

    return jax.vmap(one)(heights, places)


def spread(rng, count=COUNT, relief=800.0):
    """Places all over the image, one in every step of lines, and heights."""
    lines = (np.arange(count) + rng.uniform(0, 1, count)) * (LINES - 1) / count
    pixels = rng.uniform(0, PIXELS - 1, count)
    return np.stack([lines, pixels], 1), rng.uniform(0, relief, count)


def measured(places, rng, sigma=SIGMA, source=Source("observations")):  # noqa: B008
    """The places as measurements of image 0, with noise."""
    noisy = np.clip(places + sigma * rng.normal(size=places.shape), -0.5, (LINES - 1, PIXELS - 1))
    n = len(places)
    return Observations(
        np.zeros(n, int), np.arange(n), noisy, np.full((n, 2), max(sigma, SIGMA)), source
    )


def scanner(freedom=FREEDOM, image=None, id="A", sensor=""):
    return ScannerImage(id, satellite() if image is None else image, WGS84, freedom, sensor)


def control(X, check=()):
    roles = ["check" if k in check else "control" for k in range(len(X))]
    return local_points([f"P{k}" for k in range(len(X))], roles, X)
