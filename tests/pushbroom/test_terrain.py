"""Terrain: first hits on steep ground against dense sampling, gaps, and the ellipsoid."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from pushbroom_scenes import LINES, PIXELS, locate, satellite
from scipy.interpolate import RegularGridInterpolator

from jaxbundle.errors import InputError
from jaxbundle.geometry import ellipsoid as el
from jaxbundle.pushbroom.surfaces import Height
from jaxbundle.pushbroom.terrain import bilinear, make_terrain

rng = np.random.default_rng(5)
ROWS, COLUMNS, CELL = 40, 50, 10.0
N = 300
distance = jax.jit(jax.vmap(lambda terrain, o, d: terrain.distance(o, d), (None, 1, 1)))


def needles():
    """A flat field with towers of one cell and walls: all a sparse sampling would miss."""
    z = 5 * rng.random((ROWS, COLUMNS))
    z[rng.integers(1, ROWS - 1, 25), rng.integers(1, COLUMNS - 1, 25)] = 120
    z[:, 30] = 60
    return z


def rays(n=N):
    """Oblique rays from above a local grid that end inside it."""
    o = np.stack([rng.uniform(50, 440, n), rng.uniform(50, 340, n), np.full(n, 800.0)])
    o[:2] += rng.uniform(-300, 300, (2, n))
    aim = np.stack([rng.uniform(60, 430, n), rng.uniform(60, 330, n), np.zeros(n)])
    d = aim - o
    return o, d / np.linalg.norm(d, axis=0)


def first_hit_by_sampling(z, o, d):
    """The first of 40 000 samples of a ray below the surface, scipy's bilinear interpolation."""
    surface = RegularGridInterpolator(
        (CELL * np.arange(ROWS), CELL * np.arange(COLUMNS)), z, bounds_error=False
    )
    s = np.linspace((z.max() + 0.5 - o[2]) / d[2], (z.min() - 0.5 - o[2]) / d[2], 40_000)
    X = o[:, None] + s * d[:, None]
    below = X[2] <= surface(np.stack([X[1], X[0]], 1))
    k = below.argmax()
    return s[k], s[1] - s[0]


def test_first_hits_on_needles():
    z = needles()
    o, d = rays()
    terrain = make_terrain(z, (0.0, 0.0), (CELL, CELL), earth=None)
    s = np.array(distance(terrain, o, d))
    hits = 0
    for k in range(N):
        inside = (0 <= o[:2, k] + s[k] * d[:2, k]).all()
        if np.isnan(s[k]) or not inside:
            continue
        sampled, step = first_hit_by_sampling(z, o[:, k], d[:, k])
        # samples may miss the tip of a needle that the ray grazes, never the other way round
        assert s[k] <= sampled + 1e-9
        if abs(s[k] - sampled) > step + 1e-9:
            X = o[:, k] + s[k] * d[:, k]
            grazed = RegularGridInterpolator((CELL * np.arange(ROWS), CELL * np.arange(COLUMNS)), z)
            np.testing.assert_allclose(grazed([X[1], X[0]]), X[2], atol=1e-7)
        hits += 1
    assert hits > 0.8 * N


def test_no_height_no_point():
    z = np.full((ROWS, COLUMNS), 3.0)
    z[:, 20:24] = np.nan
    terrain = make_terrain(z, (0.0, 0.0), (CELL, CELL), earth=None)
    o = np.array([[215.0, 100.0, -300.0, 150.0], [100.0, 100.0, 100.0, 100.0], [90.0] * 4])
    d = np.array([[0, 0, 0, 1.0], [0, 0, 0, 0.0], [-1, -1, -1, -1.0]])
    s = np.array(distance(terrain, o, d))
    np.testing.assert_array_equal(np.isnan(s), [True, False, True, True])
    assert s[1] == pytest.approx(87.0)
    assert np.isnan(distance(terrain, o, -d)).all()


def test_level_terrain_is_a_height():
    image = satellite()
    lines, pixels = np.linspace(0, LINES - 1, 4), np.linspace(0, PIXELS - 1, 4)
    level = np.array(locate(image, Height(750.0), lines, pixels))
    longitude, latitude, _ = np.array(el.geodetic(el.WGS84, level))
    step = 0.002
    corner = longitude.min() - 0.01, latitude.max() + 0.01
    size = [int((v.max() - v.min() + 0.02) / step) + 2 for v in (latitude, longitude)]
    for shift in (0.0, 2 * np.pi):  # the same model, told with longitudes a turn further
        terrain = make_terrain(np.full(size, 750.0), (corner[0] + shift, corner[1]), (step, -step))
        np.testing.assert_allclose(locate(image, terrain, lines, pixels), level, atol=1e-7)


def test_point_is_on_terrain_and_ray_and_moves_with_both():
    """Residual; derivative by a height against differences; on a rough geographic model."""
    image = satellite()
    lines, pixels = np.array([100.3]), np.linspace(3, PIXELS - 5, 6)
    flat = np.array(locate(image, Height(0.0), lines, pixels))
    longitude, latitude, _ = np.array(el.geodetic(el.WGS84, flat))
    step = 2e-5
    corner = longitude.min() - 40 * step, latitude.max() + 40 * step
    size = [int((v.max() - v.min()) / step) + 80 for v in (latitude, longitude)]
    z = 400 + 60 * rng.random(size)
    terrain = make_terrain(z, corner, (step, -step))
    of = jax.jit(lambda z: locate(image, type(terrain)(
        z, terrain.origin, terrain.step, terrain.lowest, terrain.highest
    ), lines, pixels))  # fmt: skip
    X = np.array(of(terrain.heights))
    column, row, h = (np.array(v).ravel() for v in terrain.grid(tuple(X)))
    np.testing.assert_allclose(
        h, [bilinear(terrain.heights, a, b) for a, b in zip(column, row)], atol=1e-5
    )
    dz = jnp.asarray(rng.normal(size=size))
    _, exact = jax.jvp(of, (terrain.heights,), (dz,))
    ends = [np.array(of(terrain.heights + k * dz)) for k in (1e-3, -1e-3)]
    np.testing.assert_allclose(exact, (ends[0] - ends[1]) / 2e-3, atol=2e-3)


def test_terrain_without_heights_is_refused():
    with pytest.raises(InputError, match="2 × 2"):
        make_terrain(np.zeros((1, 5)), (0, 0), (1, 1))
    with pytest.raises(InputError, match="no height"):
        make_terrain(np.full((3, 5), np.nan), (0, 0), (1, 1))
