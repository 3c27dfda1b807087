"""Ellipsoid: rays, heights and geodetic coordinates against extended precision and pyproj."""

import jax
import numpy as np
import pyproj
import pytest

from jaxbundle.geometry import ellipsoid as el
from jaxbundle.geometry.vectors import point_on_ray

rng = np.random.default_rng(0)
N = 2000
SEED = el.Ellipsoid(6378e3, 6378e3, 6357e3)
TRIAXIAL = el.Ellipsoid(6.38e6, 6.37e6, 6.35e6)
distance = jax.jit(el.ray_to_ellipsoid)
height_distance = jax.jit(el.ray_to_height)
to_geodetic = jax.jit(el.geodetic)


def places(lowest=-1e4, highest=1e6):
    return np.stack([
        rng.uniform(-np.pi, np.pi, N), np.arcsin(rng.uniform(-1, 1, N)),
        rng.uniform(lowest, highest, N),
    ])  # fmt: skip


def extended(ellipsoid, place):
    """The forward formula with 64 bits of mantissa."""
    longitude, latitude, h = (np.asarray(v, np.longdouble) for v in place)
    a, c = np.longdouble(ellipsoid.a), np.longdouble(ellipsoid.c)
    e2 = 1 - (c / a) ** 2
    across = a / np.sqrt(1 - e2 * np.sin(latitude) ** 2)
    r = (across + h) * np.cos(latitude)
    return np.stack([
        r * np.cos(longitude), r * np.sin(longitude), (across * (1 - e2) + h) * np.sin(latitude)
    ])  # fmt: skip


@pytest.mark.parametrize("ellipsoid", [el.WGS84, SEED, el.sphere(6371e3)])
def test_geodetic_coordinates_are_exact_to_rounding(ellipsoid):
    given = places()
    X = extended(ellipsoid, given).astype(float)
    found = np.array(to_geodetic(ellipsoid, tuple(X)))
    np.testing.assert_allclose(found[2], given[2], atol=4e-9)
    np.testing.assert_allclose(extended(ellipsoid, found).astype(float), X, atol=4e-9)
    np.testing.assert_allclose(el.earth_fixed(ellipsoid, given), X, atol=4e-9)


def test_against_pyproj():
    longitude, latitude, h = given = places()
    peer = pyproj.Transformer.from_crs(4979, 4978, always_xy=True)
    X = np.array(peer.transform(np.degrees(longitude), np.degrees(latitude), h))
    np.testing.assert_allclose(el.earth_fixed(el.WGS84, given), X, atol=1e-8)
    np.testing.assert_allclose(np.array(to_geodetic(el.WGS84, tuple(X)))[2], h, atol=1e-8)


@pytest.mark.parametrize("X, place", [
    ((0.0, 0.0, 6356752.314245179 + 7), (0, np.pi / 2, 7)),
    ((0.0, 0.0, -6356752.314245179 - 7), (0, -np.pi / 2, 7)),
    ((-6378137.0, 0.0, 0.0), (np.pi, 0, 0)),
])  # fmt: skip
def test_poles_and_meridian(X, place):
    np.testing.assert_allclose(to_geodetic(el.WGS84, X), place, atol=2e-9)
    jacobian = np.array(jax.jacfwd(lambda X: to_geodetic(el.WGS84, X)[2])(X))
    np.testing.assert_allclose(jacobian, np.array(X) / np.linalg.norm(X), atol=1e-12)


def test_derivatives_are_those_of_the_ellipsoid():
    """∂h/∂X is the normal; ∂(λ, φ, h)/∂X is inverse to ∂X/∂(λ, φ, h)."""
    given = places()
    X = el.earth_fixed(el.WGS84, given)
    stack = lambda function: lambda x: jax.numpy.stack(function(el.WGS84, tuple(x)))
    back = jax.jit(jax.vmap(jax.jacfwd(stack(el.geodetic))))(np.stack(X, 1))
    forth = jax.jit(jax.vmap(jax.jacfwd(stack(el.earth_fixed))))(given.T)
    np.testing.assert_allclose(back[:, 2], np.stack(el.vertical(given), 1), atol=1e-13)
    scale = np.array([1e-7, 1e-7, 1.0])
    product = back / scale[:, None] @ forth * scale
    np.testing.assert_allclose(product, np.broadcast_to(np.eye(3), product.shape), atol=1e-7)


def rays(reach):
    """From 500 km above random places, towards points within `reach` radii of the centre."""
    o = np.array(el.earth_fixed(el.WGS84, places(5e5, 5e5)))
    aim = rng.normal(size=(3, N))
    aim *= reach * 6.3e6 / np.linalg.norm(aim, axis=0)
    return tuple(o), tuple(aim - o)


@pytest.mark.parametrize("ellipsoid", [el.WGS84, TRIAXIAL, el.sphere(6371e3)])
def test_nearest_point_of_a_ray(ellipsoid):
    o, d = rays(0.9)
    s = np.array(distance(ellipsoid, o, d))
    X = point_on_ray(o, d, s)
    assert np.abs(el.residual(ellipsoid, X)).max() < 1e-13
    descending = sum(n * v for n, v in zip(el.normal(ellipsoid, X), d))
    assert (descending < 0).all() and (s > 0).all()


def test_rays_that_miss():
    o, d = rays(0.5)
    away = tuple(-v for v in d)
    assert np.isnan(distance(el.WGS84, o, away)).all()
    assert np.isnan(distance(el.WGS84, (7e6, 0.0, 0.0), (-1.0, 2.5, 0.0)))
    inside = distance(el.sphere(2.0), (0.0, 0.0, 1.0), (0.0, 0.0, 1.0))
    assert inside == 1
    assert distance(el.sphere(2.0), (0.0, 0.0, 3.0), (0.0, 0.0, -1.0)) == 1


def test_ray_to_a_height():
    o, d = rays(0.9)
    for h in (-4e2, 0.0, 8848.0):
        X = point_on_ray(o, d, height_distance(el.WGS84, h, o, d))
        np.testing.assert_allclose(to_geodetic(el.WGS84, X)[2], h, atol=5e-9)
    X = point_on_ray(o, d, distance(el.at_height(el.WGS84, 8848.0), o, d))
    assert abs(to_geodetic(el.WGS84, X)[2] - 8848).max() < 6e-6 * 8848


def test_derivative_of_the_distance_against_differences():
    o, d = rays(0.7)
    value, change = jax.jit(lambda o, d: jax.jvp(
        lambda k: el.ray_to_height(el.WGS84, 100.0, o, point_on_ray(d, o, k)), (0.0,), (1.0,)
    ))(o, d)  # fmt: skip
    step = 1e-6
    ends = [height_distance(el.WGS84, 100.0, o, point_on_ray(d, o, k)) for k in (step, -step)]
    np.testing.assert_allclose(change, (ends[0] - ends[1]) / (2 * step), rtol=1e-6, atol=1e-7)
