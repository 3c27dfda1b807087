"""Refraction against a numerical integration of the ray equation in the standard atmosphere.

On a sphere n·r·sin i is constant along a ray (Bouguer); its angle φ at the centre grows by

    dφ/dr = c/(r·√(n²·r² − c²)),    c = n·r·sin i at the camera.

The air of the integration is written here again, from the table of the standard: temperatures and
lapse rates, the hydrostatic equation integrated numerically with a gravity that falls with height.
"""

from functools import partial

import jax
import numpy as np
import pytest
from scipy.integrate import quad, solve_ivp

from jaxbundle.geometry import ellipsoid as el
from jaxbundle.pushbroom.corrections import Corrections, refract
from jaxbundle.pushbroom.image import LinePose
from jaxbundle.pushbroom.image_to_ground import ground_point
from jaxbundle.pushbroom.refractivity import refractivity
from jaxbundle.pushbroom.surfaces import Height

RADIUS = 6371e3
EARTH = el.sphere(RADIUS)
SEA_LEVEL = 2.779e-4
"""n − 1 of dry air at 15 °C, 1013.25 hPa and 0.55 µm (Ciddor, 1996)."""
LAYERS = [
    (0.0, -6.5), (11.0, 0.0), (20.0, 1.0), (32.0, 2.8), (47.0, 0.0), (51.0, -2.8), (71.0, -2.0),
]  # fmt: skip
"""Geopotential kilometres and kelvin per kilometre, U.S. Standard Atmosphere 1976, table 4."""
ANGLES = 2.0, 30.0, 50.0, 60.0
GROUND = 0.0, 3443.0, 8848.0


def temperature(h):
    """Kelvin at a height in metres."""
    H, T = 6356766.0 * h / (6356766.0 + h) / 1e3, 288.15
    ends = [base for base, _ in LAYERS[1:]] + [np.inf]
    for (base, lapse), end in zip(LAYERS, ends):
        T += lapse * (np.clip(H, base if base else -np.inf, end) - base)
    return T


def falling(h, log_pressure):
    """d ln p/dh of the hydrostatic equation, for 28.9644 g/mol."""
    g = 9.80665 * (6356766.0 / (6356766.0 + h)) ** 2
    return [-28.9644e-3 * g / (8.31432 * temperature(h))]


steps = {"rtol": 1e-11, "atol": 1e-12, "dense_output": True, "max_step": 500.0}
up = solve_ivp(falling, (0.0, 84e3), [np.log(101325.0)], **steps)
down = solve_ivp(falling, (0.0, -2e3), [np.log(101325.0)], **steps)


def air(h):
    """n − 1, proportional to the density p/T."""
    if h > 84e3:
        return 0.0
    log_pressure = (up if h >= 0 else down).sol(h)[0]
    return SEA_LEVEL * np.exp(log_pressure) / 101325.0 * 288.15 / temperature(h)


@pytest.mark.parametrize("height", [-500.0, 0.0, 1500.0, 8848.0, 15e3, 25e3])
def test_air_of_the_standard_and_its_integral(height):
    N, above = refractivity(height)
    assert float(N) == pytest.approx(air(height), rel=1e-6)
    stops = [b * 1e3 for b, _ in LAYERS if b * 1e3 > height]
    expected = quad(air, height, 84e3, points=stops, limit=400, epsrel=1e-9)[0]
    # the integral ends at 84 km: above is 2e-4 of the air above 25 km
    assert float(above) == pytest.approx(expected, rel=5e-4)


def deflected(camera, ground, off_nadir):
    """Metres on the ground between the point of the straight ray and that of the refracted one."""
    top, bottom = RADIUS + camera, RADIUS + ground
    c = (1 + air(camera)) * top * np.sin(np.radians(off_nadir))

    def rate(h):
        r = RADIUS + h
        n, straight = 1 + air(h), c / (1 + air(camera))
        both = [constant / (r * np.sqrt((k * r) ** 2 - constant**2))
                for k, constant in ((1.0, straight), (n, c))]  # fmt: skip
        return both[0] - both[1]

    end = min(camera, 84e3)
    stops = [b * 1e3 for b, _ in LAYERS if ground < b * 1e3 < end]
    return bottom * quad(rate, ground, end, points=stops, limit=400, epsabs=1e-13, epsrel=1e-7)[0]


sight = jax.jit(ground_point, static_argnums=3)


@partial(np.vectorize, otypes=[float])
def found(camera, ground, off_nadir):
    P, R = np.array([RADIUS + camera, 0, 0]), np.array([[0, 0, 1.0], [1, 0, 0], [0, 1, 0]])
    pose = LinePose(P, R, np.zeros(3))
    slopes, surface = (np.tan(np.radians(off_nadir)), 0.0), Height(ground, EARTH)
    X, plain = (np.array(sight(pose, slopes, surface, Corrections(refraction=c)))
                for c in (True, False))  # fmt: skip
    assert np.linalg.norm(X) == pytest.approx(RADIUS + ground, abs=1e-6)
    return (RADIUS + ground) * (np.arctan2(plain[1], plain[0]) - np.arctan2(X[1], X[0]))


@pytest.mark.parametrize("ground", GROUND)
def test_refraction_against_the_integrated_ray(ground):
    for camera in (500e3, 770e3):
        expected = [deflected(camera, ground, angle) for angle in ANGLES]
        ratio = found(camera, ground, ANGLES) / expected
        # 60° off the nadir from 770 km is 14° above the horizon at the ground
        assert (np.abs(ratio - 1) < [1e-3, 1e-3, 1e-3, 4e-3]).all(), ratio


def test_a_camera_inside_the_air():
    """An aircraft at 6 km: only the air below it bends the ray, to a point at 300 m."""
    expected = [deflected(6e3, 300.0, angle) for angle in ANGLES]
    np.testing.assert_allclose(found(6e3, 300.0, ANGLES), expected, rtol=2e-3)


def test_no_air_between_camera_and_ground():
    o, d = (RADIUS + 100.0, 0.0, 0.0), (-1.0, 0.5, 0.0)
    start, bent = jax.jit(refract)(EARTH, 200.0, o, d)
    np.testing.assert_array_equal(start, o)
    np.testing.assert_allclose(bent, np.array(d) / np.hypot(1, 0.5), rtol=1e-15)


def test_direction_at_the_ground_keeps_the_invariant_of_bouguer():
    """n·r·sin i is the same at the camera and where the ray meets the ground."""
    o = (RADIUS + 6e5, 0.0, 0.0)
    through = jax.jit(refract)
    for tangent in (0.03, 0.5, 1.2):
        d = np.array([-1, tangent, 0]) / np.hypot(1, tangent)
        start, bent = (np.array(v) for v in through(EARTH, 0.0, o, tuple(d)))
        after = np.linalg.norm(np.cross(start, bent)) * (1 + air(0.0))
        np.testing.assert_allclose(after, np.linalg.norm(np.cross(o, d)), rtol=1e-9)
