"""Simulated images, corrected again; GeoTIFF."""

import dataclasses
import itertools

import jax.numpy as jnp
import numpy as np
import pytest
import rasterio
from pushbroom_scenes import focal_line
from scipy.interpolate import RegularGridInterpolator
from scipy.ndimage import binary_erosion

from jaxbundle.errors import InputError
from jaxbundle.io.rasters import correction
from jaxbundle.io.rasters.correction import Correction, map_of, write_corrected
from jaxbundle.io.rasters.maps import MapGrid, MapSystem
from jaxbundle.pushbroom.flight import Flight, measured_image, take_image, true_image
from jaxbundle.pushbroom.ground_to_image import make_search, project_points
from jaxbundle.pushbroom.noise import Noise
from jaxbundle.pushbroom.rectification import BLOCK_SIZE, NODE_STEP, block_places
from jaxbundle.pushbroom.signals import signal
from jaxbundle.pushbroom.surfaces import Ground, Plane
from jaxbundle.pushbroom.terrain import make_terrain

DEGREE = np.pi / 180
ORBIT = {"height": 650e3, "inclination": 97.8 * DEGREE, "node": 1.9, "argument": 0.1}
SATELLITE = Flight(
    lines=4000, pixels=400, period=1 / 400, optics=focal_line(700.0), track=ORBIT,
)  # fmt: skip


def test_signals():
    t, rng = np.linspace(0, 10, 50), np.random.default_rng(0)
    of = lambda **description: signal(description, t, 2.0, rng)
    np.testing.assert_array_equal(signal(3, t, 2.0, rng), np.full(50, 3.0))
    np.testing.assert_allclose(of(kind="linear", value=1, rate=2), 1 + 2 * (t - 2))
    sine = of(kind="sine", amplitude=2, period=5, phase=0.3)
    np.testing.assert_allclose(sine, 2 * np.sin(2 * np.pi * (t - 2) / 5 + 0.3))
    np.testing.assert_allclose(of(kind="table", times=t, values=t**3), t**3)
    walks = np.array([
        signal({"kind": "walk", "sigma": 2.0, "step": 0.5}, np.array([0.0, 4.0]), 0.0,
               np.random.default_rng(k)) for k in range(2000)
    ])  # fmt: skip
    assert np.abs(walks[:, 0]).max() < 1e-12
    np.testing.assert_allclose(np.std(walks[:, 1]), 2 * np.sqrt(4), rtol=0.06)
    one, part = (signal({"kind": "walk", "sigma": 1.0}, times, 0.0, np.random.default_rng(7))
                 for times in (t, t[::3]))  # fmt: skip
    np.testing.assert_allclose(one[::3], part, atol=1e-12)
    for times, values, words in (
        (None, t, "0 times and 50 values"), (t[1:], t, "49 times and 50 values"),
        (t[::-1], t, "times that increase"), (t[:-1], t[:-1], "to 10 s or after"),
    ):  # fmt: skip
        given = {"values": values} | ({} if times is None else {"times": times})
        with pytest.raises(InputError, match=words):
            of(kind="table", **given)
    with pytest.raises(InputError, match="did you mean 'sine'"):
        of(kind="sin")
    with pytest.raises(InputError, match="did you mean 'amplitude'"):
        of(kind="sine", amplitud=2)


AIRCRAFT = Flight(
    lines=128, pixels=128, period=0.02, optics=focal_line(60.0, x0=0.0, K1=0.0, P1=0.0),
    track={"start": [300.0, 200.0, 800.0], "velocity": [5.0, 33.0, 0.0]},
    angles={
        "roll": [{"kind": "sine", "amplitude": 0.02, "period": 3.0}, 0.01],
        "pitch": {"kind": "sine", "amplitude": 0.01, "period": 4.0},
        "yaw": {"kind": "linear", "value": -0.1, "rate": 0.005},
    },
    attitude_rate=8.0,
)  # fmt: skip


def test_the_interpolation_of_a_straight_track_is_that_given():
    for method in ("linear", "spline"):
        flight = dataclasses.replace(AIRCRAFT, position_interpolation=method)
        assert measured_image(flight).trajectory.position.method == method
    with pytest.raises(InputError, match="did you mean 'spline'"):
        measured_image(dataclasses.replace(AIRCRAFT, position_interpolation="splin"))


def pattern(x, y):
    """Two smooth bands over the ground."""
    return np.stack([
        120 + 60 * np.sin(x / 25) * np.cos(y / 31), 100 + 0.05 * x - 0.04 * y
    ])  # fmt: skip


def write_image(path, bands, dtype="float32"):
    import warnings

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", rasterio.errors.NotGeoreferencedWarning)
        with rasterio.open(
            path, "w", driver="GTiff", height=bands.shape[1], width=bands.shape[2],
            count=len(bands), dtype=dtype,
        ) as target:  # fmt: skip
            target.write(bands.astype(dtype))
    return path


def test_a_corrected_image_is_the_scene(tmp_path):
    """Of a terrain; of a plane in test_commands."""
    truth = true_image(AIRCRAFT)
    x, y = np.meshgrid(np.arange(-200, 1000, 20.0), np.arange(0, 1000, 20.0))
    height = 20 + 15 * np.sin(x / 90) * np.cos(y / 120)
    surface = make_terrain(height, (-200.0, 0.0), (20.0, 20.0), None)
    scene = MapGrid(-100.0, 900.0, 1.0, 1000, 900)
    values = pattern(*scene.centres(np.arange(900), np.arange(1000)))
    to_scene = lambda X: scene.place(X[0], X[1])
    taken = np.concatenate([
        take_image(truth, surface, jnp.asarray(values), to_scene, lines + np.arange(64.0), "cubic")
        for lines in (0, 64)
    ], axis=1)  # fmt: skip
    assert np.isfinite(taken).all()
    source = write_image(tmp_path / "image.tif", taken)
    image = measured_image(AIRCRAFT)
    system = MapSystem(None, None)
    grid = map_of(image, surface, system, 0.5)
    told = []
    write_corrected(
        source, tmp_path / "map.tif", image, make_search(image, None), surface, system, grid,
        Correction("cubic"), lambda *k: told.append(k),
    )  # fmt: skip
    with rasterio.open(tmp_path / "map.tif") as result:
        found, origin = result.read(), result.transform
    assert (origin.c, origin.f, origin.a) == (grid.x, grid.y, 0.5)
    expected = pattern(*grid.centres(np.arange(grid.rows), np.arange(grid.columns)))
    shown = np.isfinite(found[0])
    # on the outer pixel of the image its own values go on
    within = binary_erosion(shown, iterations=4)
    # the strip is some 90 m × 85 m of pixels of half a metre, turned a little
    assert 0.5 < shown.mean() < 0.95 and told[-1][1] == told[-1][2]
    assert np.abs(found - expected)[:, within].max() < 0.1
    assert sorted(p.name for p in tmp_path.iterdir()) == ["image.tif", "map.tif"]


@pytest.mark.further
def test_terrain_that_hides_terrain():
    """A ridge seen from the side, against heights along the sights in numpy."""
    roll = [{"kind": "sine", "amplitude": 0.02, "period": 3.0}, 0.6]
    flight = dataclasses.replace(AIRCRAFT, angles=AIRCRAFT.angles | {"roll": roll})
    image = measured_image(flight)  # of as many pieces: the program of the image above serves
    x, y = np.arange(-500.0, -259, 10), np.arange(150.0, 351, 10)
    heights = np.interp(np.abs(x + 385), [0, 20], [60, 0]) + 5 * np.sin(y[:, None] / 15)
    surface = make_terrain(heights, (x[0], y[0]), (10.0, 10.0), None)
    grid = MapGrid(-475.0, 330.0, 0.7, BLOCK_SIZE, BLOCK_SIZE)
    steps, every = np.arange(0, BLOCK_SIZE + NODE_STEP, NODE_STEP), np.arange(BLOCK_SIZE)
    system, search = MapSystem(None, None), make_search(image, None)
    nodes = system.nodes(surface, *grid.centres(steps, steps))
    all_, seen = (block_places(image, search, surface, nodes, o) for o in (False, True))
    chosen = np.flatnonzero(np.isfinite(all_.line.ravel()))[::17]
    east, north = (v.ravel()[chosen] for v in grid.centres(every, every))
    height = RegularGridInterpolator((y, x), heights, bounds_error=False, fill_value=-99.0)
    X = np.stack([east, north, height((north, east))])
    t = all_.line.ravel()[chosen] * flight.period
    P = np.array(flight.track["start"])[:, None] + np.outer(flight.track["velocity"], t)
    # from half a pixel of the map upwards, as far as the ridge is high
    d = (P - X) / np.linalg.norm(P - X, axis=0)
    way = X[..., None] + d[..., None] * np.r_[0.35, np.arange(0.5, 110, 0.1)]
    hidden = (height((way[1], way[0])) > way[2]).any(1)
    found = np.isnan(seen.line.ravel()[chosen])
    # at the edge of a shadow the steps of this test decide
    assert (found != hidden).mean() < 0.005
    assert 0.05 < hidden.mean() < 0.6 and len(chosen) > 500
    places = np.isfinite(seen.line)
    np.testing.assert_array_equal(seen.line[places], all_.line[places])
    # a gap of the terrain under the first pixel of the block hides nothing, and shows nothing
    with_gap = heights.copy()
    with_gap[18, 2] = np.nan
    surface = make_terrain(with_gap, (x[0], y[0]), (10.0, 10.0), None)
    of_gap = block_places(image, search, surface, nodes, True)
    assert np.isnan(of_gap.line[0, 0])
    far = np.add.outer(every, every) > 60  # pixels of 0.7 m: beyond the cells of the gap
    np.testing.assert_array_equal(np.isnan(of_gap.line)[far], np.isnan(seen.line)[far])


@pytest.mark.further
def test_a_satellite_image_in_utm(tmp_path):
    """Whole numbers, georeferenced; the map shows what the truth locates."""
    flight = dataclasses.replace(
        SATELLITE, lines=128, pixels=128, period=1 / 120, angles={"roll": 0.1, "yaw": 0.3}
    )
    image = true_image(flight)
    system = MapSystem(Ground().earth, "EPSG:32648")
    scene = map_of(image, Ground(), system, 50.0)
    wave = lambda x, y: 100 + 50 * np.sin(x / 900) * np.cos(y / 800)
    lines = np.arange(128.0)
    values = wave(*scene.centres(np.arange(scene.rows), np.arange(scene.columns)))[None]
    to_scene = lambda X: scene.place(*system.from_ground(X))
    taken = take_image(image, Ground(), jnp.asarray(values), to_scene, lines, "bilinear")
    source = write_image(tmp_path / "image.tif", taken, "uint8")
    grid = map_of(image, Ground(), system, None)
    assert 40 < grid.size < 60
    write_corrected(source, tmp_path / "map.tif", image, make_search(image), Ground(), system, grid)
    with rasterio.open(tmp_path / "map.tif") as result:
        found, crs = result.read(1).astype(float), result.crs
    assert crs.to_epsg() == 32648 and result.nodata == 0
    expected = wave(*grid.centres(np.arange(grid.rows), np.arange(grid.columns)))
    shown = found > 0
    assert shown.sum() > 0.67 * 128 * 128 * (46 / grid.size) ** 2
    assert np.abs(found - expected)[binary_erosion(shown)].max() < 2
    with pytest.raises(InputError, match="128 lines of 128 pixels; the scanner file has 4000"):
        write_corrected(source, tmp_path / "x.tif", true_image(SATELLITE), None, None, None, None)
    with pytest.raises(InputError, match="EPSG:999999"):
        MapSystem(Ground().earth, "EPSG:999999")


@pytest.mark.further
def test_a_coarse_map_is_made_in_parts(tmp_path, monkeypatch):
    """No part of the image is larger than allowed; the map is the same as made at once."""
    image, rng = measured_image(AIRCRAFT), np.random.default_rng(8)
    source = write_image(tmp_path / "image.tif", rng.uniform(0, 200, (2, 128, 128)))
    system, search, plane = MapSystem(None, None), make_search(image, None), Plane()
    grid, maps, windows = map_of(image, plane, system, 8.0), [], []
    part = correction._parts
    for most in (2**21, 3000):
        monkeypatch.setattr(correction, "_parts", lambda line, pixel, image, _, *rest, most=most: [
            windows.append([b - a for a, b in window]) or (where, window)
            for where, window in part(line, pixel, image, most, *rest)
        ])  # fmt: skip
        windows.clear()
        target = tmp_path / f"{most}.tif"
        write_corrected(source, target, image, search, plane, system, grid)
        with rasterio.open(target) as result:
            maps.append(result.read())
    assert np.prod(windows, axis=1).max() <= 3000 and len(windows) > 8
    assert np.isfinite(maps[0]).sum() > 200
    np.testing.assert_array_equal(*maps)


@pytest.mark.further
def test_a_rough_trajectory_leaves_no_holes():
    """Every pixel of the map that the search finds in the image is filled from where it is found.

    Attitudes change their course within the distance of two nodes.
    """
    noise = Noise(attitude_white=0.03 * DEGREE)
    image = measured_image(dataclasses.replace(
        SATELLITE, lines=128, pixels=128, period=1 / 150, attitude_rate=10.0, noise=noise
    ))  # fmt: skip
    system, search = MapSystem(Ground().earth, None), make_search(image)
    grid = map_of(image, Ground(), system, 0.0003)
    steps = np.arange(0, BLOCK_SIZE + NODE_STEP, NODE_STEP)
    line, pixel = block_places(
        image, search, Ground(), system.nodes(Ground(), *grid.centres(steps, steps))
    )
    # As many points at a time as there are nodes: one program for both.
    once, placed, found = [], [], []
    for rows, columns in itertools.product(range(0, 15, 3), repeat=2):
        rows, columns = (first + 15 * np.arange(len(steps)) for first in (rows, columns))
        X = system.nodes(Ground(), *grid.centres(rows, columns)).X.reshape(3, -1)
        passes = project_points(image, search, jnp.asarray(X), margin=0.0)
        once.append(np.asarray(passes.count) == 1)
        placed.append(line[np.ix_(rows, columns)].ravel())
        found.append(passes.line[0])
    once, placed, found = map(np.concatenate, (once, placed, found))
    assert once.sum() > 5000 / 9
    assert np.isnan(placed[once]).mean() < 1e-3
    np.testing.assert_allclose(np.nanmax(np.abs(placed - found)[once]), 0, atol=1e-2)
