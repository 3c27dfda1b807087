"""Maps of whole products: positions within their tolerance, several bands and types, checkpoints,
overviews and Cloud Optimized GeoTIFFs, terrain in tiles, planimetric σ."""

import os
import signal
import subprocess
import sys
import time

import jax
import numpy as np
import pytest
import rasterio
from pushbroom_scenes import satellite
from rpc_scenes import smooth_image

from jaxbundle import pushbroom
from jaxbundle.errors import InputError
from jaxbundle.geometry.ellipsoid import WGS84, geodetic
from jaxbundle.io.rasters import correction
from jaxbundle.io.rasters.checkpoints import keep_blocks
from jaxbundle.io.rasters.correction import map_of
from jaxbundle.io.rasters.maps import MapSystem
from jaxbundle.io.rasters.terrain_models import read_terrain
from jaxbundle.io.scanner.rpc import write_rpc
from jaxbundle.io.scanner.writing import write_scanner_image
from jaxbundle.pushbroom import rectification
from jaxbundle.pushbroom.error_propagation import east_north, horizontal
from jaxbundle.pushbroom.ground_to_image import make_search
from jaxbundle.pushbroom.image_to_ground import locate_lines, locate_point
from jaxbundle.pushbroom.map_accuracy import (
    MapErrors,
    covariance_lattice,
    interpolate_covariances,
)
from jaxbundle.pushbroom.noise import Noise, add_errors, draw, sigmas
from jaxbundle.pushbroom.rectification import BLOCK_SIZE, NODE_STEP, block_places
from jaxbundle.pushbroom.rpc.fitting import fit_image
from jaxbundle.pushbroom.rpc.image import RpcImage
from jaxbundle.pushbroom.surfaces import Ground, Height

pytestmark = pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")

LINES, PIXELS = 600, 400
BANDS = 3


@pytest.fixture(scope="module")
def folder(tmp_path_factory, memory_at_hand):
    return write_product(tmp_path_factory.mktemp("maps"))


def write_product(folder):
    """image.tif of three bands of 16 bits with RPC, the rigorous scanner.toml, dem.tif, and tiles/
    that are its four quarters."""
    image = smooth_image(LINES, PIXELS)
    write_scanner_image(folder, "scanner", image, WGS84, prefix="", angle_unit="deg")
    values = np.random.default_rng(1).integers(1, 3000, (BANDS, LINES, PIXELS)).astype("uint16")
    values[:, 200:230, 100:130] = 7
    with rasterio.open(folder / "image.tif", "w", driver="GTiff", width=PIXELS, height=LINES,
                       count=BANDS, dtype="uint16") as target:  # fmt: skip
        target.write(values)
    write_rpc(folder / "image.tif", fit_image(image, WGS84, (0.0, 2000.0))[0].rpc)
    ends = np.linspace(0, 1, 5)
    X = np.asarray(locate_lines(image, Ground(), ends * (LINES - 1), ends * (PIXELS - 1)))
    east, north, _ = (np.degrees(np.asarray(v)) for v in geodetic(WGS84, tuple(X)))
    step, rows, columns = 0.01, 60, 64
    west, top = east.mean() - step * columns / 2, north.mean() + step * rows / 2
    i, j = np.indices((rows, columns))
    heights = (800 + 400 * np.sin(i / 5) * np.cos(j / 7)).astype("float32")
    (folder / "tiles").mkdir()
    cuts = {"dem.tif": (slice(0, rows), slice(0, columns))} | {
        f"tiles/{a}{b}.tif": (slice(30 * a, 30 * a + 30), slice(32 * b, 32 * b + 32))
        for a in (0, 1) for b in (0, 1)
    }  # fmt: skip
    for name, (r, c) in cuts.items():
        place = rasterio.Affine(step, 0, west + step * c.start, 0, -step, top - step * r.start)
        part = heights[r, c]
        with rasterio.open(folder / name, "w", driver="GTiff", width=part.shape[1],
                           height=part.shape[0], count=1, dtype="float32", crs="EPSG:4326",
                           transform=place) as target:  # fmt: skip
            target.write(part, 1)
    return folder


def make(folder, out, **options):
    given = {"crs": "EPSG:32648", "spacing": 30.0, "dem": folder / "dem.tif"} | options
    return pushbroom.correct(folder / "image.tif", None, out, **given)


def read(path):
    with rasterio.open(path) as source:
        return source.read()


def blocks_of(image, surface, spacing):
    system = MapSystem(WGS84, "EPSG:32648")
    grid = map_of(image, surface, system, spacing)
    steps = np.arange(0, BLOCK_SIZE + NODE_STEP, NODE_STEP)
    for row in range(0, grid.rows, BLOCK_SIZE):
        for column in range(0, grid.columns, BLOCK_SIZE):
            yield system.nodes(surface, *grid.centres(row + steps, column + steps))


def test_terrain_that_has_a_part_of_the_image_is_told(folder, tmp_path):
    """A quarter of the model, whose middle is that of the image; nothing is said of the whole."""
    said = []
    made = make(folder, tmp_path / "part.tif", dem=folder / "tiles" / "00.tif", tell=said.append)
    (words,) = said
    share = float(words.partition("no height for ")[2].split()[0])
    assert "00.tif" in words and share == pytest.approx(75, abs=10)
    whole = make(folder, tmp_path / "whole.tif", tell=said.append)
    assert len(said) == 1
    assert made.rows * made.columns < 0.5 * whole.rows * whole.columns


@pytest.mark.further
@pytest.mark.parametrize("kind", ["rpc", "rigorous", "restless"])
def test_interpolated_positions_are_those_of_the_model(folder, monkeypatch, kind):
    """Within the tolerance, on terrain; what bends faster than it allows is projected itself."""
    image = satellite() if kind == "restless" else smooth_image(LINES, PIXELS)
    surface, search = Ground(), None
    if kind != "restless":
        surface = read_terrain(folder / "dem.tif", WGS84)
    if kind == "rpc":
        image = RpcImage(fit_image(image, WGS84, (0.0, 2000.0))[0].rpc, LINES, PIXELS)
    else:
        search = make_search(image)
    used = []
    evaluate = rectification._evaluate
    monkeypatch.setattr(rectification, "_evaluate", lambda *g: used.append(1) or evaluate(*g))
    compared, spacing, tolerance = 0, 30.0, 0.02
    for nodes in list(blocks_of(image, surface, spacing))[::2]:
        near, exact = (
            block_places(image, search, surface, nodes, tolerance=t) for t in (tolerance, 0.0)
        )
        if exact is None or near is None:
            # a pixel at the edge may be on either side of it
            assert (near is None) == (exact is None)
            continue
        both = np.isfinite(near.line) & np.isfinite(exact.line)
        assert (both == np.isfinite(exact.line)).mean() > 0.999
        off = np.hypot(near.line - exact.line, near.pixel - exact.pixel)[both]
        assert off.max() < tolerance
        compared += both.sum()
    assert compared > 50_000 and used


@pytest.mark.further
def test_bands_types_and_no_data(folder, tmp_path):
    """Values of no data stay apart from those that show it by chance; lanczos keeps a constant."""
    for nodata, kind in ((7, "nearest"), (65535, "lanczos"), (None, "nearest")):
        target = tmp_path / f"{nodata}.tif"
        make(folder, target, nodata=nodata, resampling=kind)
        with rasterio.open(target) as map_:
            values, missing = map_.read(), map_.nodata
        assert values.shape[0] == BANDS and values.dtype == "uint16"
        assert missing == (nodata or 0)
        shown = (values != missing).all(0)
        # as many pixels of 30 m as the image has of some 40 m, turned
        assert 0.3 < shown.mean() < 0.9
        seven = 8 if nodata == 7 else 7
        assert (values[:, shown] == seven).all(0).sum() > 500
    with rasterio.open(folder / "image.tif") as source:
        profile, bands = source.profile, source.read()
    gaps = tmp_path / "gaps.tif"
    with rasterio.open(gaps, "w", **profile | {"nodata": 7}) as target:
        target.write(bands)
    with rasterio.open(folder / "image.tif") as source, rasterio.open(gaps, "r+") as target:
        target.rpcs = source.rpcs
    options = {"crs": "EPSG:32648", "spacing": 30.0, "dem": folder / "dem.tif"}
    pushbroom.correct(gaps, None, tmp_path / "of_gaps.tif", **options)
    values = read(tmp_path / "of_gaps.tif")
    # the area of 7 is no data, with a border of the kernel
    make(folder, tmp_path / "plain.tif")
    lost = (values == 7) & (read(tmp_path / "plain.tif") > 0)
    assert 500 < lost.all(0).sum() < 3000


def test_the_same_bytes_after_an_interruption(folder, tmp_path, monkeypatch):
    """A run that ends after some blocks, its file cut in the middle of one, resumes."""
    whole = tmp_path / "whole.tif"
    make(folder, whole)
    kept, target = tmp_path / "blocks", tmp_path / "map.tif"

    def stop(stage, done, total):
        if done == 4:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        make(folder, target, checkpoint=kept, progress=stop)
    assert sorted(os.listdir(tmp_path)) == ["blocks", "whole.tif"]
    kept.write_bytes(kept.read_bytes()[:-1000])
    computed, places = [], correction.block_places
    monkeypatch.setattr(correction, "block_places", lambda *g: computed.append(1) or places(*g))
    told = []
    make(folder, target, checkpoint=kept, progress=lambda *state: told.append(state))
    assert target.read_bytes() == whole.read_bytes()
    assert 0 < len(computed) < told[-1][2] and not kept.exists()


@pytest.mark.further
def test_the_same_bytes_after_a_kill(folder, tmp_path):
    """Of the command, by the system."""
    command = [
        sys.executable, "-m", "jaxbundle", "pushbroom", "correct", str(folder / "image.tif"),
        "--dem", str(folder / "dem.tif"), "--crs", "EPSG:32648", "--spacing", "8",
        "--checkpoint", str(tmp_path / "blocks"), "--out",
    ]  # fmt: skip
    subprocess.run([*command, str(tmp_path / "whole.tif")], check=True, capture_output=True)
    process = subprocess.Popen([*command, str(tmp_path / "map.tif")])
    begun = time.monotonic()
    while time.monotonic() < begun + 120:
        size = (tmp_path / "blocks").stat().st_size if (tmp_path / "blocks").exists() else 0
        if size > 2_000_000:
            break
        time.sleep(0.01)
    process.send_signal(signal.SIGKILL)
    process.wait()
    assert not (tmp_path / "map.tif").exists()
    subprocess.run([*command, str(tmp_path / "map.tif")], check=True, capture_output=True)
    assert (tmp_path / "map.tif").read_bytes() == (tmp_path / "whole.tif").read_bytes()


def test_a_checkpoint_of_another_map_is_refused(folder, tmp_path):
    kept = tmp_path / "blocks"
    with pytest.raises(KeyboardInterrupt), keep_blocks(kept, "0" * 16):
        raise KeyboardInterrupt
    with pytest.raises(InputError, match="blocks of another map"):
        make(folder, tmp_path / "map.tif", checkpoint=kept)
    kept.write_text("a letter")
    with pytest.raises(InputError, match="file of something else"):
        make(folder, tmp_path / "map.tif", checkpoint=kept)
    assert kept.read_text() == "a letter" and os.listdir(tmp_path) == ["blocks"]


def test_a_cloud_optimized_map_has_the_same_values(folder, tmp_path):
    make(folder, tmp_path / "plain.tif")
    make(folder, tmp_path / "cog.tif", cog=True)
    make(folder, tmp_path / "small.tif", compress="deflate", overviews=True)
    for name, layout in (("cog.tif", "COG"), ("small.tif", None)):
        with rasterio.open(tmp_path / name) as map_:
            assert map_.tags(ns="IMAGE_STRUCTURE").get("LAYOUT") == layout
            assert map_.compression.name == "deflate" and map_.nodata == 0
            halves = map_.overviews(1)
            assert halves[0] == 2 and max(map_.shape) / halves[-1] <= BLOCK_SIZE
            values = map_.read()
        np.testing.assert_array_equal(values, read(tmp_path / "plain.tif"))
        with rasterio.open(tmp_path / name, overview_level=0) as map_:
            half = map_.read(1).astype(float)
        # the mean of four pixels; of an odd number of them GDAL shifts the fours a little
        rows, columns = (n // 2 for n in values.shape[1:])
        four = values[0][: 2 * rows, : 2 * columns].reshape(rows, 2, columns, 2)
        full = (four > 0).all((1, 3))
        mean = four.mean((1, 3))[full]
        assert half.shape == tuple(-(-n // 2) for n in values.shape[1:])
        assert np.corrcoef(half[:rows, :columns][full], mean)[0, 1] > 0.8
    assert not [name for name in os.listdir(tmp_path) if name.startswith(".")]


def test_tiles_are_one_terrain(folder, tmp_path):
    make(folder, tmp_path / "one.tif")
    done = make(folder, tmp_path / "tiles.tif", dem=folder / "tiles")
    np.testing.assert_array_equal(read(tmp_path / "one.tif"), read(tmp_path / "tiles.tif"))
    assert done.heights == f"{folder / 'tiles'} above the ellipsoid"
    odd = tmp_path / "odd"
    odd.mkdir()
    with pytest.raises(InputError, match="no terrain tiles"):
        read_terrain(odd, WGS84)
    for name, west in (("a", 0.0), ("b", 0.555)):
        with rasterio.open(odd / f"{name}.tif", "w", driver="GTiff", width=5, height=5, count=1,
                           dtype="int16", crs="EPSG:4326",
                           transform=rasterio.Affine(.1, 0, west, 0, -.1, 1)) as tile:  # fmt: skip
            tile.write(np.ones((1, 5, 5), "int16"))
    with pytest.raises(InputError, match="b.tif.*not on the lattice of a.tif"):
        read_terrain(odd, WGS84)


@pytest.mark.further
def test_sigma_against_draws():
    """Errors of attitude and position, of the measured place and the height of the terrain."""
    image = smooth_image(LINES, PIXELS)
    noise = Noise(attitude_bias=2e-5, position_bias=3.0)
    errors = MapErrors(noise, image=0.3, height=20.0, ground=1.5)
    line, pixel, level = 123.0, 310.0, 700.0
    lattice = covariance_lattice(image, WGS84, (0.0, 1500.0), errors)
    found = interpolate_covariances(lattice, *(np.full(1, v) for v in (line, pixel, level)))[:, 0]
    X0 = locate_point(image, Height(level), line, pixel)
    axes = east_north(Ground(), X0)
    sigma = sigmas(image, noise)

    @jax.jit
    def one(key):
        keys = jax.random.split(key, 4)
        wrong = add_errors(image, draw(sigma, keys[0]))
        at = np.array([line, pixel]) + 0.3 * jax.random.normal(keys[1], (2,))
        height = level + 20.0 * jax.random.normal(keys[2])
        X = locate_point(wrong, Height(height), at[0], at[1])
        return horizontal(axes, X0, X) + 1.5 * jax.random.normal(keys[3], (2,))

    offsets = np.array(jax.lax.map(one, jax.random.split(jax.random.key(0), 4000)))
    C = offsets.T @ offsets / len(offsets)
    # σ of a variance from 4000 draws: √(2/4000) = 2 % of it
    np.testing.assert_allclose(found[:2], np.diag(C), rtol=0.1)
    assert abs(found[2] - C[0, 1]) < 0.1 * np.sqrt(C[0, 0] * C[1, 1])


@pytest.mark.further
def test_a_map_of_sigma(folder, tmp_path):
    """From an RPC: the stated ground, and the height times the slope of the sight."""
    with pytest.raises(InputError, match="states no error.*ground"):
        make(folder, tmp_path / "map.tif", sigma=tmp_path / "sigma.tif")
    done = make(folder, tmp_path / "map.tif", sigma=tmp_path / "sigma.tif",
                errors={"ground": 3.0, "height": 50.0})  # fmt: skip
    with rasterio.open(tmp_path / "sigma.tif") as source:
        east, north, both = source.read()
        assert source.descriptions[2] == "planimetric sigma [m]"
    shown = (read(tmp_path / "map.tif") > 0).all(0)
    assert (np.isfinite(both) == shown).mean() > 0.999
    np.testing.assert_allclose(both, np.hypot(east, north), rtol=1e-6)
    image = smooth_image(LINES, PIXELS)
    # the sight of the middle: how far its point moves in a metre of height
    ends = [locate_point(image, Height(h), LINES / 2, PIXELS / 2) for h in (800.0, 801.0)]
    slope = np.linalg.norm(horizontal(east_north(Ground(), ends[0]), *ends))
    expected = np.sqrt(2 * 9 + (50 * slope) ** 2)
    rows, columns = np.nonzero(shown)
    middle = int(rows.mean()), int(columns.mean())
    assert both[middle] == pytest.approx(expected, rel=5e-3)
    assert done.rms_sigma == pytest.approx(float(np.sqrt(np.nanmean(both**2))), rel=1e-5)


@pytest.mark.parametrize("options, words", [
    ({"nodata": -1.0}, "--nodata -1: .*uint16"), ({"nodata": np.nan}, "--nodata nan"),
    ({"tolerance": -1.0}, "--tolerance"), ({"compress": "jpeg"}, "compress"),
    ({"errors": {"ground": 1.0}}, "--error"), ({"resampling": "sinc"}, "resampling"),
    ({"sigma": "s.tif", "errors": {"grund": 1.0}}, "did you mean 'ground'"),
    ({"sigma": "s.tif", "errors": {"attitude_bias": 1.0}}, "rational polynomials only"),
    ({"sigma": "s.tif", "errors": {"ground": -1.0}}, "from 0 on"),
    ({"checkpoint": "nowhere/blocks"}, "no folder nowhere"),
    ({"checkpoint": "map.tif"}, "also --out"),
])  # fmt: skip
def test_bad_input_is_named(folder, tmp_path, monkeypatch, options, words):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(InputError, match=words) as found:
        make(folder, "map.tif", **options)
    assert "\n" not in str(found.value) and os.listdir(tmp_path) == []


def test_a_map_replaces_none_of_its_inputs(folder, tmp_path):
    geoid = tmp_path / "geoid.tif"
    geoid.write_text("heights")
    with pytest.raises(InputError, match="--sigma .*geoid.tif: is part of the input"):
        make(folder, tmp_path / "map.tif", geoid=geoid, sigma=geoid, errors={"ground": 1.0})
    assert geoid.read_text() == "heights"


def test_bands_of_several_types_are_refused(folder, tmp_path):
    vrt = (
        "<VRTDataset rasterXSize='400' rasterYSize='600'>"
        + "".join(
            f"<VRTRasterBand dataType='{kind}' band='{k}'><SimpleSource><SourceFilename>"
            f"{folder / 'image.tif'}</SourceFilename><SourceBand>{k}</SourceBand></SimpleSource>"
            "</VRTRasterBand>" for k, kind in ((1, "UInt16"), (2, "Float32"))
        ) + "</VRTDataset>"
    )  # fmt: skip
    (tmp_path / "several.vrt").write_text(vrt)
    with pytest.raises(InputError, match="bands of uint16, float32"):
        pushbroom.correct(folder / "scanner.toml", tmp_path / "several.vrt", tmp_path / "map.tif",
                          height=0.0)  # fmt: skip


def test_what_a_killed_process_left_of_a_map_is_removed(tmp_path):
    """Of a process that does not run; not of one that does, and not of other files."""
    import os
    import subprocess
    import sys

    from jaxbundle.io.writing.replacing import remove_left_behind

    ended = subprocess.Popen([sys.executable, "-c", ""])
    ended.wait()
    gone, kept = tmp_path / f".map.{ended.pid}.tif", [
        tmp_path / f".map.{os.getpid()}.tif", tmp_path / f".other.{ended.pid}.tif",
        tmp_path / f".map.{ended.pid}.tif.aux", tmp_path / "map.tif",
    ]  # fmt: skip
    for path in (gone, *kept):
        path.write_bytes(b"x")
    remove_left_behind(tmp_path / "map.tif")
    assert not gone.exists() and all(path.exists() for path in kept)
    remove_left_behind(tmp_path / "none" / "map.tif")
