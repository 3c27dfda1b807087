"""Rational polynomial coefficients that the tests share."""

import jax.numpy as jnp
import numpy as np
from pushbroom_scenes import orbit

from jaxbundle.pushbroom.ancillary import attitude_table, position_table
from jaxbundle.pushbroom.image import make_image
from jaxbundle.pushbroom.rpc.fitting import RpcTable
from jaxbundle.pushbroom.rpc.polynomials import Rpc, project_points
from jaxbundle.pushbroom.scanner import AnglePolynomial, LineTimes
from jaxbundle.pushbroom.trajectory import Trajectory


def made_up(seed=3, **changes):
    """Coefficients near those of a level scanner, every one of them in use; across the date line.

    Lines go south by latitude, samples east by longitude, each 0.1 by height.
    """
    rng = np.random.default_rng(seed)
    size = np.r_[1e-2, np.full(3, 1e-2), np.full(6, 1e-3), np.full(10, 1e-4)]
    a, b, c, d = rng.normal(size=(4, 20)) * size
    a[[2, 3]] += -1.0, 0.1
    c[[1, 3]] += 1.0, -0.1
    b[0], d[0] = 1.0, 1.0
    given = {
        "line_numerator": a, "line_denominator": b, "sample_numerator": c,
        "sample_denominator": d, "line_offset": 3000.5, "line_scale": 3001.0,
        "sample_offset": 2500.0, "sample_scale": 2501.0, "longitude_offset": 179.98,
        "longitude_scale": 0.12, "latitude_offset": -23.4, "latitude_scale": 0.11,
        "height_offset": 400.0, "height_scale": 600.0,
    } | changes  # fmt: skip
    return Rpc(**{name: jnp.asarray(value, float) for name, value in given.items()})


def places(rpc, n=40, seed=5):
    """(L, P, H) in the middle of the domain as longitudes, latitudes (radians) and heights."""
    L, P, H = np.random.default_rng(seed).uniform(-0.85, 0.85, (3, n))
    return (
        np.radians(float(rpc.longitude_offset) + float(rpc.longitude_scale) * L),
        np.radians(float(rpc.latitude_offset) + float(rpc.latitude_scale) * P),
        float(rpc.height_offset) + float(rpc.height_scale) * H,
    )


def table_of(rpc, size=(7, 7, 4), noise=0.0, seed=0):
    """A grid over 0.85 of the domain as an `RpcTable`, with noise of lines and samples."""
    L, P, H = np.meshgrid(*(np.linspace(-0.85, 0.85, n) for n in size))
    longitude = np.radians(float(rpc.longitude_offset) + float(rpc.longitude_scale) * L.ravel())
    latitude = np.radians(float(rpc.latitude_offset) + float(rpc.latitude_scale) * P.ravel())
    height = float(rpc.height_offset) + float(rpc.height_scale) * H.ravel()
    line, sample, _ = (np.asarray(a) for a in project_points(rpc, longitude, latitude, height))
    e = noise * np.random.default_rng(seed).normal(size=(2, len(line)))
    return RpcTable(longitude, latitude, height, line + e[0], sample + e[1])


def smooth_image(lines=600, pixels=400, half=0.02, seconds=4.0):
    """A scanner that rotates evenly, over the orbit of `pushbroom_scenes`, without jitter."""
    t = np.arange(-6.0, 12.0)
    angles = np.stack([0.01 + 2e-4 * t, -0.1 + 3e-4 * t + 1e-5 * t**2, 0.02 - 1e-4 * t], 1)
    attitude = attitude_table(t, angles, method="spline", reference="orbit")
    optics = AnglePolynomial(
        jnp.array([0, half, 0, half**3 / 3]), jnp.array([0.001, 0, 1e-5]),
        jnp.float64((pixels - 1) / 2), jnp.float64(pixels / 2),
    )  # fmt: skip
    times = LineTimes(jnp.float64(0.0), jnp.float64(seconds / lines))
    track = Trajectory(position_table(t, *orbit(t)), attitude)
    return make_image(track, times, optics, lines, pixels)
