"""Rational polynomial coefficients that the tests share."""

import jax.numpy as jnp
import numpy as np

from jaxbundle.pushbroom.rpc import Rpc


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
