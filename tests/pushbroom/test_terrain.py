"""Terrain: first hits on steep ground against dense sampling, gaps, and the ellipsoid."""

import equinox as eqx
import jax
import numpy as np
import pytest
from pushbroom_scenes import LINES, PIXELS, geodetic, locate, satellite
from scipy.interpolate import RegularGridInterpolator

from jaxbundle.errors import InputError
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
    z[0, :2] = -np.inf, np.inf
    terrain = make_terrain(z, (0.0, 0.0), (CELL, CELL), earth=None)
    assert terrain.lowest == terrain.highest == 3
    o = np.array([[215.0, 100.0, -300.0, 150.0], [100.0, 100.0, 100.0, 100.0], [90.0] * 4])
    d = np.array([[0, 0, 0, 1.0], [0, 0, 0, 0.0], [-1, -1, -1, -1.0]])
    s = np.array(distance(terrain, o, d))
    np.testing.assert_array_equal(np.isnan(s), [True, False, True, True])
    assert s[1] == pytest.approx(87.0)
    assert np.isnan(distance(terrain, o, -d)).all()


def test_ground_is_found_over_voids():
    """Rays from beyond the grid, over a void, into it; strict; what the void may have hidden.

    Towers without height in them: the rays are those of the whole field, hits in voids and behind
    what they hid excepted.
    """
    z = needles()
    z[:, 30:] += 40
    voids = z.copy()
    voids[5:25, 8:20] = np.nan
    voids[:, 30] = np.nan
    o, d = rays()
    o[:, ::3] -= 0.97 * 800 / d[2, ::3] * -d[:, ::3]  # these begin low, beyond the edge or inside
    whole, passing, strict = (
        make_terrain(heights, (0.0, 0.0), (CELL, CELL), None, over)
        for heights, over in ((z, True), (voids, True), (voids, False))
    )
    s, over, ends = (np.array(distance(terrain, o, d)) for terrain in (whole, passing, strict))
    X = o + s * d
    cell = np.clip(np.nan_to_num(X[1::-1] // CELL).astype(int), 0, [[ROWS - 2], [COLUMNS - 2]])
    corners = [voids[cell[0] + i, cell[1] + j] for i in (0, 1) for j in (0, 1)]
    known = np.isfinite(s) & np.isfinite(np.sum(corners, 0))
    np.testing.assert_allclose(over[known], s[known], atol=1e-9)
    hidden = np.isfinite(s) & ~known & np.isfinite(over)
    assert (over[hidden] > s[hidden]).all() and hidden.sum() < 0.2 * N
    assert (np.isfinite(s) & ~known & np.isnan(over)).sum() > 10
    # without a pass a ray ends at the first void: nothing is found that was not, and less
    found = np.isfinite(ends)
    np.testing.assert_allclose(ends[found], s[found], atol=1e-9)
    assert (known & ~found).sum() > 10


IMAGE = satellite()
PLACES = np.linspace(0, LINES - 1, 4), np.linspace(0, PIXELS - 1, 4)
SIZE = 500, 400


@jax.jit
def located(terrain, z, dz):
    """Points on a terrain with the heights z, and their derivative in the direction dz."""
    of = lambda z: locate(IMAGE, eqx.tree_at(lambda t: t.heights, terrain, z), *PLACES)
    return jax.jvp(of, (z,), (dz,))


def under(X):
    """Corner and step of a model of `SIZE` under all points."""
    longitude, latitude, _ = np.array(geodetic(tuple(X)))
    margin = 0.001
    step = [(np.ptp(v) + 2 * margin) / n for v, n in ((longitude, SIZE[1]), (latitude, SIZE[0]))]
    return (longitude.min() - margin, latitude.max() + margin), (step[0], -step[1])


def test_level_terrain_is_a_height():
    level = np.array(locate(IMAGE, Height(750.0), *PLACES))
    corner, step = under(level)
    for shift in (0.0, 2 * np.pi):  # the same model, told with longitudes a turn further
        terrain = make_terrain(np.full(SIZE, 750.0), (corner[0] + shift, corner[1]), step)
        X, _ = located(terrain, terrain.heights, np.zeros(SIZE))
        np.testing.assert_allclose(X, level, atol=1e-7)


def test_point_is_on_terrain_and_ray_and_moves_with_both():
    """Residual; derivative by a height against differences; on a rough geographic model."""
    corner, step = under(locate(IMAGE, Height(0.0), *PLACES))
    terrain = make_terrain(400 + 60 * rng.random(SIZE), corner, step)
    z, dz = np.array(terrain.heights), rng.normal(size=SIZE)
    X, exact = (np.array(v) for v in located(terrain, z, dz))
    column, row, h = (np.array(v).ravel() for v in jax.jit(type(terrain).grid)(terrain, tuple(X)))
    np.testing.assert_allclose(h, jax.jit(jax.vmap(bilinear, (None, 0, 0)))(z, column, row),
                               atol=1e-5)  # fmt: skip
    ends = [np.array(located(terrain, z + k * dz, dz)[0]) for k in (1e-3, -1e-3)]
    np.testing.assert_allclose(exact, (ends[0] - ends[1]) / 2e-3, atol=2e-3)


def test_terrain_without_heights_is_refused():
    with pytest.raises(InputError, match="2 × 2"):
        make_terrain(np.zeros((1, 5)), (0, 0), (1, 1))
    with pytest.raises(InputError, match="no valid height"):
        make_terrain(np.full((3, 5), np.nan), (0, 0), (1, 1))
