"""Image to ground against independent computations, corrections, and derivatives."""

from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pyproj
import pytest
from pushbroom_scenes import (
    LINES,
    PERIOD,
    PIXELS,
    above_a_plane,
    attitude,
    focal_line,
    locate,
    orbit,
    quaternions,
    satellite,
)  # fmt: skip
from scipy.interpolate import CubicHermiteSpline
from scipy.optimize import brentq
from scipy.spatial.transform import Rotation, Slerp

from jaxbundle.errors import InputError
from jaxbundle.geometry import ellipsoid as el
from jaxbundle.pushbroom.corrections import (
    Corrections,
    apparent_direction,
    apparent_point,
    earlier_earth,
    true_direction,
)
from jaxbundle.pushbroom.earth_frames import EARTH_RATE, GM
from jaxbundle.pushbroom.image import LinePose, make_image, pose_at
from jaxbundle.pushbroom.image_to_ground import ground_point, locate_points
from jaxbundle.pushbroom.scanner import AnglePolynomial, AngleTable, LineTimes, slopes_of
from jaxbundle.pushbroom.surfaces import Ground, Height, Plane

pose_of, slopes = jax.jit(pose_at), jax.jit(slopes_of)
SOME_LINES = np.linspace(0, LINES - 1, 8)
SOME_PIXELS = np.linspace(0, PIXELS - 1, 5)


def test_plane_by_the_published_equations():
    """Eq. 2-7 to 2-9 of Hakim et al.: X = T − Tz·(R·[u, v, f])/(R·[u, v, f])z."""
    pitch, roll, yaw = 0.05, -0.08, 0.3
    X = locate(above_a_plane((pitch, roll, yaw)), Plane(20.0), SOME_LINES, SOME_PIXELS)
    R = Rotation.from_euler("XYZ", [pitch, roll, yaw]).as_matrix()
    u, v, f = 0.05 * (SOME_PIXELS - (PIXELS - 1) / 2), 0.3, -120.0
    ray = R @ np.stack([u, v + 0 * u, f + 0 * u])
    T = np.stack([0 * SOME_LINES, 50 * 0.01 * SOME_LINES, 1000 + 0 * SOME_LINES])
    expected = T[:, :, None] - (T[2] - 20)[:, None] * (ray / ray[2])[:, None]
    np.testing.assert_allclose(X, expected, atol=1e-9)


def test_against_scipy_and_pyproj():
    """Hermite orbit, slerp, Brown's correction in numpy, pyproj's height as the surface: 1e-6 m."""
    peer = pyproj.Transformer.from_crs(4978, 4979, always_xy=True)
    image = satellite("hermite", "slerp")
    X = np.array(locate(image, Height(321.0), SOME_LINES, SOME_PIXELS))
    t = np.arange(-6.0, 11.0)
    P, V = orbit(t)
    position = CubicHermiteSpline(t, P, V)
    rows = np.arange(-1, 5.5, 0.1)
    turns = Slerp(rows, attitude(rows))
    mounting = Rotation.from_euler("XYZ", [0.01, -0.02, 0.3])
    for i, line in enumerate(SOME_LINES):
        o, R = position(line * PERIOD), turns(line * PERIOD) * mounting
        for j, pixel in enumerate(SOME_PIXELS):
            x, y = 0.05 * (pixel - (PIXELS - 1) / 2) - 0.02, 0.3
            r2 = x * x + y * y
            dx = x * 2e-6 * r2 + 1e-6 * (r2 + 2 * x * x)
            dy = y * 2e-6 * r2 + 2e-6 * x * y
            d = R.apply([x + dx, y + dy, -700.0])
            d /= np.linalg.norm(d)
            above = lambda s, o=o, d=d: peer.transform(*(o + s * d))[2] - 321
            s = brentq(above, 4e5, 6e5, xtol=1e-9)
            np.testing.assert_allclose(X[:, i, j], o + s * d, atol=1e-6)


@pytest.mark.parametrize(
    "earth", [el.WGS84, el.sphere(6371e3), el.Ellipsoid(6378e3, 6371e3, 6357e3)]
)
def test_points_are_on_the_ellipsoid_and_on_the_ray(earth):
    image = satellite()
    X = locate(image, Ground(earth), SOME_LINES, SOME_PIXELS)
    assert np.abs(el.residual(earth, np.array(X))).max() < 1e-12
    pose = pose_of(image, SOME_LINES[3] * PERIOD)
    xi, eta = slopes(image.optics, SOME_PIXELS[2:3])
    ray = np.array(pose.R) @ [xi[0], eta[0], -1.0]
    sight = np.array(X)[:, 3, 2] - np.array(pose.P)
    assert np.linalg.norm(np.cross(sight, ray / np.linalg.norm(ray))) < 1e-8


def test_scattered_points_are_those_of_the_lines():
    image = satellite()
    X = locate(image, Ground(), SOME_LINES, SOME_PIXELS)
    lines, pixels = (a.ravel() for a in np.meshgrid(SOME_LINES, SOME_PIXELS, indexing="ij"))
    np.testing.assert_allclose(
        jax.jit(locate_points)(image, Ground(), lines, pixels), X.reshape(3, -1), atol=1e-8
    )


def test_rays_off_the_earth_have_no_point():
    up = eqx.tree_at(lambda i: i.mounting, satellite(), jnp.array([0.0, 1.5, 0.0]))
    assert np.isnan(locate(up, Ground(), SOME_LINES, SOME_PIXELS)).all()
    assert np.isnan(locate(above_a_plane((2.0, 0.0, 0.0)), Plane(), SOME_LINES, SOME_PIXELS)).all()


def test_optics_of_all_kinds_see_the_same():
    line = focal_line()
    u = np.arange(PIXELS, dtype=float)
    xi, eta = (np.array(v) for v in slopes(line, u))
    table = AngleTable(jnp.asarray(np.arctan(xi)), jnp.asarray(np.arctan(eta)))
    middle, half = (PIXELS - 1) / 2, PIXELS / 2
    fit = lambda y: jnp.asarray(np.polynomial.polynomial.polyfit((u - middle) / half, y, 6))
    polynomial = AnglePolynomial(fit(xi), fit(eta), jnp.float64(middle), jnp.float64(half))
    for other in (table, polynomial):
        np.testing.assert_allclose(slopes(other, u), (xi, eta), atol=1e-12)
    between = u - 0.5  # also beyond the first pixel
    np.testing.assert_allclose(slopes(table, between), slopes(line, between), atol=1e-9)


def test_times_of_lines():
    times = LineTimes(jnp.float64(2.0), jnp.float64(0.5))
    table = LineTimes(jnp.float64(0), jnp.float64(0), 2 + 0.5 * jnp.arange(20.0))
    for line in (-0.5, 0.0, 3.25, 19.5):
        assert times.time(line) == table.time(jnp.float64(line)) == 2 + 0.5 * line
        assert times.line(times.time(line)) == table.line(table.time(jnp.float64(line))) == line


def test_an_image_longer_than_its_tables_is_refused():
    image = satellite()
    with pytest.raises(InputError, match="attitude: image line 810 .* outside the table"):
        make_image(image.trajectory, image.times, image.optics, 1000, PIXELS)


P = tuple(orbit([0.0])[0][0])
V = tuple(orbit([0.0])[1][0])


def test_aberration_is_the_sum_of_velocities():
    seen = (0.1, -0.2, -1.0)
    l = np.array(jax.jit(true_direction)(seen, V))
    np.testing.assert_allclose(np.linalg.norm(l), 1)
    sight = 299792458 * l + np.array(V)
    np.testing.assert_allclose(np.cross(sight / np.linalg.norm(sight), seen), 0, atol=1e-14)
    again = np.array(jax.jit(apparent_direction)(tuple(l), V))
    np.testing.assert_allclose(np.cross(again / np.linalg.norm(again), seen), 0, atol=1e-14)


def test_light_time_turns_the_earth():
    """In an inertial frame light travels in a straight line, and the ground moves meanwhile."""
    v = np.array([6378e3, 1e5, 2e5])
    seconds = 5e5 / 299792458
    turn = Rotation.from_rotvec([0, 0, EARTH_RATE * seconds])
    np.testing.assert_allclose(earlier_earth(tuple(v), 5e5), turn.apply(v), atol=1e-9)


@partial(jax.jit, static_argnums=1)
def sight(pose, corrections, slopes=(0.3, 0.1)):
    return ground_point(pose, slopes, Ground(), corrections)


@partial(jax.jit, static_argnums=0)
def back(corrections, P, V, X):
    return apparent_point(corrections, el.WGS84, P, V, X)


@pytest.mark.parametrize("name, least, most", [
    ("light_time", 0.3, 1.3), ("aberration", 10, 20), ("refraction", 0.01, 3),
])  # fmt: skip
def test_size_and_inverse_of_corrections(name, least, most):
    """`apparent_point` undoes what the correction did to the ray."""
    pose = pose_of(satellite(), 1.0)
    of = lambda corrections: np.array(sight(pose, corrections))
    corrections = Corrections(**{name: True})
    plain, moved = of(Corrections()), of(corrections)
    assert least < np.linalg.norm(moved - plain) < most
    seen = back(corrections, tuple(pose.P), tuple(pose.V), tuple(moved))
    sights = [np.array(X) - pose.P for X in (seen, plain)]
    a, b = (sight / np.linalg.norm(sight) for sight in sights)
    assert np.linalg.norm(np.cross(a, b)) * 6e5 < 1e-7


@pytest.mark.parametrize("off_nadir, light, aberration, refraction", [
    (5, (0.78, 1.25), (12.7, 20.0), (0.22, 0.23)), (30, (0.91, 1.47), (14.8, 23.5), (2.1, 2.4)),
    (50, (1.28, 2.15), (21.0, 34.5), (10.7, 15.3)),
])  # fmt: skip
def test_sizes_off_the_nadir(off_nadir, light, aberration, refraction):
    """The table of docs/pushbroom.md, from 500 and 800 km above the equator, looking east.

    Over a plane refraction moves the ground by ∫(n − 1) dh·tan z/cos² z; the integral of air that
    weighs 101325 N/m² and has 1.225 kg/m³ and n − 1 = 2.779e-4 at the ground is 2.34 m.
    """
    slopes = np.tan(np.radians(off_nadir)), 0.0
    for k, h in enumerate((500e3, 800e3)):
        P = np.array([el.WGS84.a + h, 0, 0])
        V = np.array([0, 0, np.sqrt(GM / P[0])])
        pose = LinePose(P, np.array([[0, 0, 1.0], [1, 0, 0], [0, 1, 0]]), V)
        at = lambda *c, pose=pose: np.array(sight(pose, Corrections(*map(bool, c)), slopes))
        plain = at(0, 0, 0)
        d = (plain - P) / np.linalg.norm(plain - P)
        cosine = -d @ plain / np.linalg.norm(plain)
        expected = 2.779e-4 / 1.225 * 101325 / 9.78 * np.sqrt(1 - cosine**2) / cosine**3
        sizes = [np.linalg.norm(at(*c) - plain) for c in np.eye(3)]
        np.testing.assert_allclose(sizes[2], expected, rtol=0.02)
        told = light[k], aberration[k], refraction[k]
        np.testing.assert_allclose(sizes, told, rtol=0.08)


def test_derivatives_by_every_parameter():
    """Positions, attitudes, mounting, lens, times, offsets: each leaf in a random direction."""
    image = satellite("hermite", "slerp")
    lines, pixels = np.array([10.3, 222.0, 541.7]), SOME_PIXELS  # between the rows of the tables
    arrays, static = eqx.partition(image, eqx.is_inexact_array)
    at = lambda a: locate_points(eqx.combine(a, static), Height(50.0), lines, pixels[:3])
    change = jax.jit(lambda a, da: jax.jvp(at, (a,), (da,)))
    leaves, tree = jax.tree.flatten(jax.tree.map(np.asarray, arrays))
    rng = np.random.default_rng(3)
    # a step that moves the ground by a centimetre, whatever the unit of the parameter
    for k, leaf in enumerate(leaves):
        direction = [np.zeros_like(a) for a in leaves]
        direction[k] = rng.normal(size=leaf.shape)
        turn = jax.tree.unflatten(tree, direction)
        exact = np.array(change(arrays, turn)[1])
        step = min(0.01 / max(np.abs(exact).max(), 1e-9), 1e3)
        ends = [leaves[:k] + [leaf + s * step * direction[k]] + leaves[k + 1 :] for s in (1, -1)]
        moved = [np.array(change(jax.tree.unflatten(tree, end), turn)[0]) for end in ends]
        difference = (moved[0] - moved[1]) / (2 * step)
        np.testing.assert_allclose(exact, difference, atol=1e-5 * np.abs(exact).max() + 1e-7)


def test_quaternions_of_the_scene_are_what_they_seem():
    t = np.array([0.0, 1.0])
    np.testing.assert_allclose(
        Rotation.from_quat(np.roll(quaternions(t), -1, axis=1)).as_matrix(), attitude(t).as_matrix()
    )
