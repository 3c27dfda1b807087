"""What the values of rasters are: scale, offset and no-data of bands, vertical systems; maps or
crops where the own lines of a scanner are expected; systems of another part of the Earth."""

import numpy as np
import pyproj
import pytest
import rasterio

from jaxbundle.commands.scanner_inputs import surface_of
from jaxbundle.errors import InputError
from jaxbundle.geometry.ellipsoid import WGS84
from jaxbundle.io.rasters.maps import describe_distance
from jaxbundle.io.rasters.scenes import read_scene
from jaxbundle.io.rasters.terrain_models import read_terrain
from jaxbundle.surfaces.scanner_inputs import read_grey
from jaxbundle.system.rasters import check_raw

STORED = np.arange(30, dtype=np.int16).reshape(5, 6) * 10
NORTH_UP = rasterio.transform.Affine(0.01, 0, 13, 0, -0.01, 41)


def write(path, values=STORED, crs="EPSG:4326", transform=NORTH_UP, scale=1.0, offset=0.0,
          nodata=-9999):  # fmt: skip
    with rasterio.open(
        path, "w", driver="GTiff", width=6, height=5, count=1, dtype=values.dtype, crs=crs,
        transform=transform, nodata=nodata,
    ) as target:  # fmt: skip
        target.write(values[None])
        if (scale, offset) != (1, 0):
            target.scales, target.offsets = (scale,), (offset,)
    return path


@pytest.mark.parametrize("projected", [False, True])
def test_scale_offset_and_no_data_of_a_terrain_model(tmp_path, projected):
    values = STORED.copy()
    values[2, 3] = -9999
    system = {"crs": "EPSG:32633", "transform": rasterio.transform.Affine(
        900, 0, 330_000, 0, -900, 4_540_000)} if projected else {}  # fmt: skip
    plain = read_terrain(write(tmp_path / "a.tif", values, **system), WGS84)
    scaled = read_terrain(write(tmp_path / "b.tif", values, scale=0.1, offset=50, **system), WGS84)
    assert np.isnan(np.asarray(plain.heights)).any()
    np.testing.assert_allclose(scaled.heights, 0.1 * plain.heights + 50, rtol=1e-12)
    assert scaled.highest == pytest.approx(0.1 * plain.highest + 50)
    if not projected:
        assert np.isnan(plain.heights[2, 3]) and plain.heights[0, 1] == 10


@pytest.mark.parametrize("projected", [False, True])
@pytest.mark.parametrize("mark", [-9999, -32768, 32767])
def test_a_mark_of_no_data_that_is_not_declared(tmp_path, projected, mark):
    """Its value is named, not that of neighbours mixed with it; a sea as deep is one."""
    values = STORED.copy()
    values[2:4, 3:5] = mark
    system = {"crs": "EPSG:32633", "transform": rasterio.transform.Affine(
        900, 0, 330_000, 0, -900, 4_540_000)} if projected else {}  # fmt: skip
    with pytest.raises(InputError, match=f"height {mark}, the others 0 to 290; .*-a_nodata {mark}"):
        read_terrain(write(tmp_path / "a.tif", values, nodata=None, **system), WGS84)
    scaled = write(tmp_path / "b.tif", values, nodata=None, scale=0.5, offset=10, **system)
    with pytest.raises(InputError, match=f"height {0.5 * mark + 10:g}, .*-a_nodata {mark} FILE"):
        read_terrain(scaled, WGS84)
    sea = np.linspace(0, -10_000, 30).reshape(5, 6).astype(np.float64)
    found = read_terrain(write(tmp_path / "c.tif", sea, nodata=None, **system), WGS84)
    assert np.nanmin(found.heights) < -9000


def test_scale_and_no_data_of_a_scene(tmp_path):
    values = STORED.copy()
    values[2, 3] = -9999
    scene = read_scene(write(tmp_path / "a.tif", values, scale=0.5, offset=1), WGS84)
    expected = 0.5 * STORED + 1
    expected[2, 3] = np.nan
    np.testing.assert_array_equal(scene.bands[0], expected)
    assert scene.dtype == "float32"
    assert read_grey(tmp_path / "a.tif")[2, 3] == 0


def compound(vertical):
    return pyproj.CRS.from_user_input(f"EPSG:4326+{vertical}").to_wkt()


@pytest.mark.parametrize("vertical, words", [
    (5773, ["EGM96 height", "--geoid us_nga_egm96_15.tif", "gdal_translate -a_srs EPSG:4326"]),
    (3855, ["EGM2008 height", "us_nga_egm08_25.tif"]),
])  # fmt: skip
def test_heights_above_a_geoid_are_not_taken_for_ellipsoidal(tmp_path, vertical, words):
    path = write(tmp_path / "dem.tif", crs=compound(vertical))
    with pytest.raises(InputError) as told:
        surface_of(WGS84, None, path)
    for word in ("dem.tif", *words):
        assert word in str(told.value)
    grid = write(tmp_path / "geoid.tif", np.full((5, 6), 40, np.int16))
    found = surface_of(WGS84, None, path, geoid=grid)
    np.testing.assert_allclose(found.heights, STORED + 40.0, atol=1e-9)


def test_units_and_directions_of_vertical_systems(tmp_path):
    """NAVD88 in US survey feet; depths below the mean sea level."""
    plain = np.asarray(read_terrain(write(tmp_path / "a.tif"), WGS84).heights)
    for code, factor in ((6360, 1200 / 3937), (5715, -1.0)):
        path = write(tmp_path / f"{code}.tif", crs=compound(code))
        found = read_terrain(path, WGS84, above_geoid=True)
        np.testing.assert_allclose(found.heights, factor * plain, rtol=1e-9)


def test_ellipsoidal_heights_need_no_geoid(tmp_path):
    path = write(tmp_path / "dem.tif", crs=pyproj.CRS.from_epsg(4979).to_wkt())
    grid = write(tmp_path / "geoid.tif", np.full((5, 6), 40, np.int16))
    np.testing.assert_allclose(surface_of(WGS84, None, path).heights, STORED)
    with pytest.raises(InputError, match="dem.tif: .*above the ellipsoid.*omit --geoid"):
        surface_of(WGS84, None, path, geoid=grid)


RAW = rasterio.transform.Affine.identity()


@pytest.mark.parametrize("crs, transform, words", [
    ("EPSG:32633", rasterio.transform.Affine(0.5, 0, 4e5, 0, -0.5, 4e6), "is a map, in EPSG:32633"),
    (None, rasterio.transform.Affine(1, 0, 1000, 0, 1, 2000), "line 2000, pixel 1000 of a larger"),
    (None, RAW, ""), ("EPSG:4326", RAW, ""),
])  # fmt: skip
@pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")
def test_maps_and_crops_are_not_the_lines_of_a_scanner(tmp_path, crs, transform, words):
    path = write(tmp_path / "image.tif", crs=crs, transform=transform)
    with rasterio.open(path) as source:
        if not words:
            return check_raw(path, source)
        with pytest.raises(InputError, match=f"image.tif: .*{words}.*as the scanner took it"):
            check_raw(path, source)


@pytest.mark.parametrize("crs, longitude, latitude, zone", [
    ("EPSG:32633", 13.0, 47.0, ""), ("EPSG:32633", 20.0, 47.0, ""), ("EPSG:4326", 13.0, 47.0, ""),
    ("EPSG:32660", -179.0, 47.0, ""), ("EPSG:32618", 13.0, 47.0, "EPSG:32633"),
    ("EPSG:32733", 13.0, 47.0, "EPSG:32633"), ("EPSG:31287", -70.0, -30.0, "EPSG:32719"),
    ("EPSG:3832", -175.0, -30.0, ""),
])  # fmt: skip
def test_a_system_of_another_part_of_the_earth(crs, longitude, latitude, zone):
    said = describe_distance(crs, longitude, latitude)
    assert (zone in said and crs in said) if zone else said == ""
