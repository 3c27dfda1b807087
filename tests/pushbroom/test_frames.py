"""Frames against the steps of the IERS conventions; orbits against sgp4 and Kepler."""

import erfa
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxbundle.errors import InputError
from jaxbundle.pushbroom.earth_frames import (
    ARCSECOND,
    EARTH_RATE,
    EarthOrientation,
    circular_orbit,
    julian_date,
    to_earth,
    turn_positions,
    turn_quaternions,
    two_line_orbit,
)

EPOCH = "2016-06-22T04:00:12.25"
TIMES = np.arange(0.0, 60.0, 7.0)
EOP = EarthOrientation(-0.2, 0.11, 0.47)
# the example of Vallado et al. (2006), AIAA 2006-6753
TLE = (
    "1 00005U 58002B   00179.78495062  .00000023  00000-0  28098-4 0  4753",
    "2 00005  34.2682 348.7242 1859667 331.7664  19.3264 10.82419157413667",
)


def angle(A, B):
    return np.abs(Rotation.from_matrix(A @ np.swapaxes(B, -1, -2)).magnitude()).max()


def test_gcrf_by_the_steps_of_the_conventions():
    """CIO based: pole X, Y, s; Earth rotation angle; polar motion with s′."""
    day, part = erfa.dtf2d("UTC", 2016, 6, 22, 4, 0, 12.25)
    part = part + TIMES / 86400
    tai = erfa.utctai(day, part)
    tt = erfa.taitt(*tai)
    ut1 = erfa.taiut1(*tai, EOP.ut1_utc - 36)  # 36 leap seconds until 2016
    celestial = erfa.c2ixys(*erfa.xys06a(*tt))
    polar = erfa.pom00(EOP.x_pole * ARCSECOND, EOP.y_pole * ARCSECOND, erfa.sp00(*tt))
    steps = erfa.c2tcio(celestial, erfa.era00(*ut1), polar)
    assert angle(to_earth("GCRF", EPOCH, TIMES, EOP), steps) < 1e-9


def test_mean_equator_of_2000():
    turn = np.swapaxes(to_earth("GCRF", EPOCH, TIMES), 1, 2) @ to_earth("J2000", EPOCH, TIMES)
    bias = Rotation.from_matrix(turn).as_rotvec() / ARCSECOND * 1e3
    # ICRS to mean J2000: dα0 = −14.6, ξ0 = −16.617, η0 = −6.819 mas (IERS 2010, 5.21, 5.33)
    np.testing.assert_allclose(np.abs(bias), np.broadcast_to([6.819, 16.617, 14.6], bias.shape),
                               atol=0.01)  # fmt: skip


def test_teme_turns_by_sidereal_time_of_1982():
    """Vallado's example: TEME to the pseudo Earth-fixed frame, without polar motion."""
    teme = np.array([5094.18016210, 6127.64465950, 6380.34453270])
    itrf = np.array([-1033.4793830, 7901.2952754, 6380.3565958])
    eop = EarthOrientation(-0.439961, -0.140682, 0.333309)
    R = to_earth("TEME", "2004-04-06T07:51:28.386009", np.zeros(1), eop)[0]
    np.testing.assert_allclose(R @ teme, itrf, atol=2e-6)


def test_velocities_are_rates_of_positions():
    P = np.array([[7e6, 1e5, 2e5]])
    V = np.array([[1e2, 5e3, 5e3]])
    h = 0.5
    times = np.array([-h, 0.0, h])
    for frame in ("GCRF", "TEME"):
        R = to_earth(frame, EPOCH, times, EOP)
        moved, _ = turn_positions(R, P + V * times[:, None])
        _, rate = turn_positions(R[1:2], P, V, EOP)
        np.testing.assert_allclose(rate[0], (moved[2] - moved[0]) / (2 * h), atol=2e-4)


def test_attitudes_turn_with_the_frame():
    q = np.random.default_rng(0).normal(size=(len(TIMES), 4))
    q /= np.linalg.norm(q, axis=1, keepdims=True)
    R = to_earth("GCRF", EPOCH, TIMES)
    matrix = lambda q: Rotation.from_quat(np.roll(q, -1, axis=1)).as_matrix()
    np.testing.assert_allclose(matrix(turn_quaternions(R, q)), R @ matrix(q), atol=1e-14)


def test_two_line_elements():
    """Position in TEME at the elements' epoch as published (Vallado et al., 2006, 00005)."""
    epoch = "2000-06-27T18:50:19.733568"
    P, V = two_line_orbit(*TLE, epoch, np.array([0.0, 1e-2]))
    teme = np.array([7022.46529266, -1400.08296755, 0.03995155]) * 1e3
    R = to_earth("TEME", epoch, np.zeros(1))[0]
    np.testing.assert_allclose(R.T @ P[0], teme, atol=0.2)
    # short-period terms of SGP4's velocity are of first order only
    np.testing.assert_allclose(V[0], (P[1] - P[0]) / 1e-2, atol=2)
    with pytest.raises(InputError, match="line 2: .* checksum"):
        two_line_orbit(TLE[0], TLE[1].replace("34.2682", "35.2682"), epoch, np.zeros(1))
    other = TLE[1].replace("00005", "00014")
    with pytest.raises(InputError, match="two satellites"):
        two_line_orbit(TLE[0], other, epoch, np.zeros(1))


def test_circular_orbit():
    times = np.linspace(-5, 5, 11)
    P, V = circular_orbit(times, 5e5, np.radians(97.4), 0.3, 0.6)
    np.testing.assert_allclose(np.linalg.norm(P, axis=1), 6878137)
    inertial = V + np.cross([0, 0, EARTH_RATE], P)
    np.testing.assert_allclose(np.linalg.norm(inertial, axis=1), 7612.6, atol=0.1)
    momentum = np.cross(P, inertial)
    np.testing.assert_allclose(momentum[:, 2] / np.linalg.norm(momentum, axis=1),
                               np.cos(np.radians(97.4)), atol=1e-12)  # fmt: skip
    np.testing.assert_allclose((P[2:] - P[:-2]) / 2, V[1:-1], atol=0.01)


def test_epochs():
    assert julian_date("2000-01-01T12:00:00") == (2451544.5, 0.5)
    assert julian_date("2024-03-01T01:30:00+02:00") == (2460369.5, pytest.approx(23.5 / 24))
    for bad in ("yesterday", "2024-13-01"):
        with pytest.raises(InputError, match="ISO 8601"):
            julian_date(bad)
    with pytest.raises(InputError, match="did you mean 'TEME'"):
        to_earth("TMEE", EPOCH, TIMES)
    assert jnp.allclose(to_earth("ITRF", EPOCH, TIMES), np.eye(3))
