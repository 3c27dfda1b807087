"""Images with rational polynomials where a scanner file can stand: `info`, `locate`, `project`,
`correct`; each beside the rigorous image that the coefficients were fitted to."""

import json
import subprocess
import sys

import jax
import numpy as np
import pytest
import rasterio
from rpc_scenes import made_up, places, smooth_image

from jaxbundle import pushbroom
from jaxbundle.errors import InputError
from jaxbundle.geometry.ellipsoid import WGS84, geodetic
from jaxbundle.io.rasters.maps import MapGrid, MapSystem
from jaxbundle.io.scanner.rpc import write_rpc
from jaxbundle.io.scanner.writing import write_scanner_image
from jaxbundle.io.text.csv_tables import write_csv
from jaxbundle.pushbroom import rpc
from jaxbundle.pushbroom.ground_to_image import make_search
from jaxbundle.pushbroom.rectification import BLOCK_SIZE, NODE_STEP, TOLERANCE, block_places
from jaxbundle.pushbroom.rpc.fitting import fit_image
from jaxbundle.pushbroom.rpc.image import RpcImage
from jaxbundle.pushbroom.surfaces import Height
from jaxbundle.pushbroom.terrain import make_terrain

pytestmark = pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")

LINES, PIXELS = 600, 400
HEIGHTS = (0.0, 2000.0)


@pytest.fixture(scope="module")
def scene():
    """The rigorous image, and the polynomials that follow it to a thousandth of a pixel."""
    image = smooth_image(LINES, PIXELS)
    fit, check = fit_image(image, WGS84, HEIGHTS)
    assert check.largest.max() < 1e-3
    return image, fit.rpc


@pytest.fixture(scope="module")
def folder(scene, tmp_path_factory):
    """scanner.toml of the rigorous image; image.tif, whose bands are line and pixel, with tags."""
    folder = tmp_path_factory.mktemp("rpc")
    image, coefficients = scene
    write_scanner_image(folder, "scanner", image, WGS84, prefix="", angle_unit="deg")
    write_picture(folder / "image.tif")
    write_rpc(folder / "image.tif", coefficients)
    write_rpc(folder / "apart_RPC.TXT", coefficients)
    return folder


def write_picture(path, lines=LINES, pixels=PIXELS):
    bands = np.indices((lines, pixels)).astype("float32")
    with rasterio.open(
        path, "w", driver="GTiff", width=pixels, height=lines, count=2, dtype="float32"
    ) as target:
        target.write(bands)


def test_many_positions_start_from_polynomials_and_end_where_single_ones_do():
    """Over the whole domain, its edges and beyond, of coefficients with all terms."""
    coefficients = made_up()
    longitude, latitude, height = places(coefficients, 300)
    line, sample, _ = rpc.project_points(coefficients, longitude, latitude, height)
    many = rpc.locate_points(coefficients, line, sample, height)
    one = jax.vmap(lambda *at: rpc.locate(coefficients, *at))(line, sample, height)
    for found, alone, true in zip(many, one, (longitude, latitude)):
        np.testing.assert_allclose(found, true, atol=1e-13)
        np.testing.assert_allclose(found, alone, atol=1e-15)


def test_positions_that_need_more_steps_get_them():
    """Twenty domains away: one step from the polynomial is not enough, and none is lost."""
    coefficients = made_up()
    line, sample = np.array([3000.0, -50_000.0]), np.array([2500.0, 40_000.0])
    longitude, latitude, status = rpc.locate_points(coefficients, line, sample, np.zeros(2))
    seen = rpc.project_points(coefficients, longitude, latitude, np.zeros(2))
    good = np.asarray(status) != rpc.RpcStatus.NOT_CONVERGED
    assert good[0]
    np.testing.assert_allclose(np.asarray(seen[0])[good], line[good], atol=1e-6)
    np.testing.assert_allclose(np.asarray(seen[1])[good], sample[good], atol=1e-6)


@pytest.mark.parametrize("name", ["image.tif", "apart_RPC.TXT"])
def test_located_and_projected_as_the_rigorous_image(folder, name, tmp_path):
    given = {"grid": (4, 3), "height": 700.0}
    own = pushbroom.locate(folder / "scanner.toml", **given).table()
    # without a raster its size is that of the domain: the same places are given
    write_csv(tmp_path / "places.csv", ("line", "pixel"), np.c_[own["line"], own["pixel"]].tolist())
    found = pushbroom.locate(folder / name, points=tmp_path / "places.csv", height=700.0).table()
    assert (found["status"] == "found").all()
    X, Y = (np.stack([table[axis] for axis in "XYZ"]) for table in (own, found))
    # a thousandth of a pixel of 15 m and more
    assert np.linalg.norm(X - Y, axis=0).max() < 0.05
    write_csv(tmp_path / "ground.csv", ("X", "Y", "Z"), Y.T.tolist())
    back = pushbroom.project(folder / name, tmp_path / "ground.csv").table()
    np.testing.assert_allclose(back["line"], own["line"], atol=1e-6)
    np.testing.assert_allclose(back["pixel"], own["pixel"], atol=1e-6)
    assert (back["status"] == "in the image").all() and (back["count"] == 1).all()


@pytest.mark.further
def test_what_is_off_the_image_or_the_domain_is_said(folder, tmp_path):
    (tmp_path / "places.csv").write_text("line,pixel\n300,200\n650,200\n")
    told = []
    found = pushbroom.locate(
        folder / "image.tif", points=tmp_path / "places.csv", height=9000.0, tell=told.append
    ).table()
    assert list(found["status"]) == [rpc.RpcStatus.OUTSIDE.meaning, "off the image"]
    assert np.isnan(found["X"][1]) and np.isfinite(found["X"][0])
    assert "heights from 0 to 2000 m; the ground is at 9000 m" in told[0]
    assert "off the image, which has 600" in told[1] and "heights from 0 to 2000 m" in told[2]
    ground = pushbroom.locate(folder / "image.tif", grid=(2, 2), height=0.0).table()
    names = ("longitude", "latitude", "height")
    rows = np.c_[[ground[name] for name in names]].T
    rows[0] += [1.0, 0, 0]
    write_csv(tmp_path / "ground.csv", names, rows.tolist())
    told.clear()
    seen = pushbroom.project(folder / "image.tif", tmp_path / "ground.csv", tell=told.append)
    assert list(seen.table()["status"]) == ["off the image", *["in the image"] * 3]
    assert "ground.csv, line 2" in told[0] and "not in the image of 600 × 400 (1 of 4" in told[0]
    write_csv(tmp_path / "away.csv", names, rows[:1].tolist())
    with pytest.raises(InputError, match="no point is in the image; this one is at line"):
        pushbroom.project(folder / "image.tif", tmp_path / "away.csv")


@pytest.mark.parametrize("given", [("image.tif", None), ("apart_RPC.TXT", "image.tif")])
def test_a_map_shows_what_the_polynomials_see(folder, scene, tmp_path, given):
    """The bands are line and pixel themselves, which bilinear resampling keeps."""
    scanner, image = (name and folder / name for name in given)
    done = pushbroom.correct(scanner, image, tmp_path / "map.tif", height=500.0)
    with rasterio.open(tmp_path / "map.tif") as source:
        line, pixel = source.read(1), source.read(2)
        rows, columns = np.nonzero(np.isfinite(line))
        x, y = rasterio.transform.xy(source.transform, rows, columns)
    assert (done.rows, done.columns) == line.shape and len(rows) > 0.4 * line.size
    seen = rpc.project_points(scene[1], np.radians(x), np.radians(y), np.full(len(rows), 500.0))
    # beyond the centres of the outermost pixels the picture is constant
    inner = (seen[0] > 0) & (seen[0] < LINES - 1) & (seen[1] > 0) & (seen[1] < PIXELS - 1)
    inner = np.asarray(inner)
    for band, true in zip((line, pixel), seen):
        # the tested error is that of nodes twice as far apart: four times as large
        np.testing.assert_allclose(band[rows, columns][inner], true[inner], atol=TOLERANCE / 4)


@pytest.mark.further
def test_hidden_terrain_is_hidden_for_both(scene):
    """A wall of 1500 m: rigorous image and polynomials agree on what it hides."""
    image, coefficients = scene
    system = MapSystem(WGS84, None)
    X = pushbroom.locate_points(image, Height(0.0), np.array([300.0]), np.array([200.0]))
    longitude, latitude, _ = (np.degrees(float(v)) for v in geodetic(WGS84, tuple(X[:, 0])))
    # cells of 22 m: the slope of the wall is steeper than the rays
    n, half = 1500, 30
    heights = np.zeros((n, n))
    heights[:, n // 2 - half : n // 2 + half] = 1500.0
    heights[n // 2 - half : n // 2 + half, :] = 1500.0
    corner = np.radians([longitude - 0.15, latitude - 0.15])
    terrain = make_terrain(heights, corner, np.radians([0.3 / n, 0.3 / n]), WGS84)
    size = 0.1 / BLOCK_SIZE
    grid = MapGrid(longitude - 0.05, latitude + 0.05, size, BLOCK_SIZE, BLOCK_SIZE)
    at = np.arange(0, BLOCK_SIZE + 1, NODE_STEP, dtype=float)
    nodes = system.nodes(terrain, *grid.centres(at, at))
    both = RpcImage(coefficients, LINES, PIXELS), None
    own = image, make_search(image, WGS84)
    masks = []
    for seen_by in (both, own):
        shown, all_ = (
            np.isfinite(block_places(*seen_by, terrain, nodes, hide).line) for hide in (True, False)
        )
        masks.append((all_, all_ & ~shown))
    (seen, hidden), (own_seen, own_hidden) = masks
    assert (seen == own_seen).mean() > 0.999
    assert 0.005 < own_hidden[own_seen].mean() < 0.5
    # pixels at the edge of a shadow may fall on either side
    assert (hidden != own_hidden).sum() < 0.03 * own_hidden.sum()
    # a gap of the terrain under the first pixel of the block changes its surroundings only
    gap = heights.copy()
    gap[998:1003, 498:503] = np.nan
    terrain = make_terrain(gap, corner, np.radians([0.3 / n, 0.3 / n]), WGS84)
    shown = np.isfinite(block_places(*both, terrain, nodes, True).line)
    assert not shown[0, 0]
    np.testing.assert_array_equal(shown[20:], (seen & ~hidden)[20:])


@pytest.mark.further
def test_info_says_the_same_of_both(folder):
    own = pushbroom.info(folder / "scanner.toml", height=700.0).to_dict()
    found = pushbroom.info(folder / "image.tif", height=700.0).to_dict()
    assert (own["model"], found["model"]) == ("rigorous", "rational polynomials")
    assert (found["lines"], found["pixels"], found["heights"]) == (LINES, PIXELS, "0 to 2000")
    for name in ("ground_sampling_along", "ground_sampling_across"):
        assert found[name] == pytest.approx(own[name], rel=1e-3)
    # the polynomials know the ray by its chord through their heights
    assert found["incidence"] == pytest.approx(own["incidence"], abs=0.01)
    assert found["azimuth"] == pytest.approx(own["azimuth"], abs=0.05)
    for corner, other in zip(own["corners"], found["corners"]):
        assert corner["longitude"] == pytest.approx(other["longitude"], abs=1e-6)
        assert corner["latitude"] == pytest.approx(other["latitude"], abs=1e-6)
    assert found["height"] == 700.0 and own["duration"] == pytest.approx(4.0 * 599 / 600)


@pytest.mark.further
def test_commands_as_processes(folder, tmp_path):
    def run(*arguments):
        command = [sys.executable, "-m", "jaxbundle", "pushbroom", *map(str, arguments)]
        return subprocess.run(command, capture_output=True, text=True, cwd=tmp_path)

    done = run("info", folder / "image.tif", "--json", "-")
    assert done.returncode == 0 and json.loads(done.stdout)["lines"] == LINES
    done = run("accuracy", folder / "image.tif", "--attitude-white", "0.01")
    assert done.returncode == 2 and "Traceback" not in done.stderr
    assert "rational polynomials" in done.stderr and "rigorous" in done.stderr


def test_the_ground_is_where_the_polynomials_hold(tmp_path, scene):
    """Without a height: 0, or the middle of their heights, which is said; by all commands alike."""
    image, _ = scene
    high = fit_image(image, WGS84, (1000.0, 3000.0))[0].rpc
    write_picture(tmp_path / "high.tif")
    write_rpc(tmp_path / "high.tif", high)
    told = []
    found = pushbroom.locate(tmp_path / "high.tif", grid=(2, 2), tell=told.append).table()
    np.testing.assert_allclose(found["height"], 2000.0, atol=1e-6)
    assert pushbroom.info(tmp_path / "high.tif", tell=told.append).figures["height"] == 2000.0
    pushbroom.correct(tmp_path / "high.tif", None, tmp_path / "map.tif", tell=told.append)
    assert len(told) == 3 and all("1000 to 3000 m, not for 0" in line for line in told)


@pytest.mark.further
def test_coefficients_of_the_whole_image_beside_a_tile_are_said(scene, tmp_path):
    write_picture(tmp_path / "tile.tif", LINES // 2)
    write_rpc(tmp_path / "tile_RPC.TXT", scene[1])
    told = []
    pushbroom.info(tmp_path / "tile.tif", tell=told.append)
    assert len(told) == 1 and "is it a tile" in told[0] and "300 of 400" in told[0]


def test_a_raster_without_coefficients_is_refused(tmp_path):
    write_picture(tmp_path / "plain.tif", 10, 12)
    with pytest.raises(InputError, match="no RPC tags"):
        pushbroom.locate(tmp_path / "plain.tif")
    (tmp_path / "plain.png").write_bytes(b"")
    with pytest.raises(InputError, match=r"no coefficients beside it: expected plain_RPC\.TXT"):
        pushbroom.info(tmp_path / "plain.png")
    with pytest.raises(InputError, match="give the image as well"):
        pushbroom.correct(tmp_path / "a_RPC.TXT", None, tmp_path / "map.tif")
