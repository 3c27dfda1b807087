"""Heights of surfaces above the ellipsoid or a geoid: `--geoid`, `--heights`, `--crs`."""

import numpy as np
import pytest
import rasterio
from surface_scenes import write_geoid

from jaxbundle.errors import InputError
from jaxbundle.io.rasters.vertical import split_system, with_heights_above
from jaxbundle.surfaces.height_reference import (
    check_cells,
    heights_of_ground_images,
    heights_of_photographs,
    no_height_reference,
)

UTM = "EPSG:32632"


@pytest.fixture(scope="module")
def geoid(tmp_path_factory):
    return write_geoid(tmp_path_factory.mktemp("geoid") / "own.tif")


@pytest.mark.parametrize("name, code", [("us_nga_egm96_15.tif", 5773), ("own.gtx", None)])
def test_a_system_with_heights_goes_through_a_geotiff(tmp_path, name, code):
    """Map and heights are those that were written, by code or by name."""
    system = with_heights_above(UTM, tmp_path / name)
    path = tmp_path / "dsm.tif"
    transform = rasterio.transform.Affine(1, 0, 5e5, 0, -1, 5e6)
    with rasterio.open(path, "w", driver="GTiff", width=2, height=2, count=1, dtype="float32",
                       crs=system, transform=transform) as raster:  # fmt: skip
        raster.write(np.zeros((1, 2, 2), np.float32))
    assert [p.name for p in tmp_path.iterdir()] == ["dsm.tif"]
    with rasterio.open(path) as raster:
        parts = split_system(raster.crs.to_wkt())
    assert parts.horizontal == UTM and parts.vertical.to_epsg() == code
    assert parts.vertical.name == ("EGM96 height" if code else "height above the geoid own.gtx")


@pytest.mark.parametrize("crs, geoid, heights, above", [
    (UTM, None, None, "ellipsoid"), (UTM, None, "ellipsoid", "ellipsoid"),
    (UTM, "own.tif", None, "geoid"), (UTM, "own.tif", "geoid", "geoid"),
    (UTM + "+5773", "own.tif", None, "geoid"), ("EPSG:4979", None, None, "ellipsoid"),
])  # fmt: skip
def test_heights_of_ground_images(crs, geoid, heights, above):
    found = heights_of_ground_images(crs, geoid, heights)
    assert f"above the {above}" in found.words and found.sign == -(above == "geoid")
    assert (split_system(found.system).vertical is not None) == (above == "geoid")
    assert found.horizontal == ("EPSG:4326" if crs == "EPSG:4979" else UTM)


@pytest.mark.parametrize("crs, geoid, heights, words, sign", [
    (None, None, None, "", 0), (UTM, None, None, "", 0),
    (UTM, None, "ellipsoid", "above the ellipsoid, of the block", 0),
    (UTM + "+5773", None, None, "above the geoid: EGM96 height, of the block", 0),
    (UTM, "own.tif", None, "of the block above the ellipsoid; above the geoid own.tif", -1),
    (UTM + "+5773", "own.tif", "ellipsoid", "ellipsoid: EGM96 height and the geoid own.tif", 1),
])  # fmt: skip
def test_heights_of_photographs(crs, geoid, heights, words, sign):
    found = heights_of_photographs(crs, geoid, heights)
    assert words in found.words and bool(words) == bool(found.words) and found.sign == sign


@pytest.mark.parametrize("choose, crs, geoid, heights, said", [
    (heights_of_ground_images, UTM + "+5773", None, None, "--geoid us_nga_egm96_15.tif"),
    (heights_of_ground_images, UTM, None, "geoid", "--geoid us_nga_egm96_15.tif"),
    (heights_of_ground_images, UTM, "own.tif", "ellipsoid", "above the ellipsoid already"),
    (heights_of_ground_images, UTM + "+5773", None, "ellipsoid", "give one of them"),
    (heights_of_ground_images, UTM + "+3855", "us_nga_egm96_15.tif", None, "us_nga_egm08_25.tif"),
    (heights_of_ground_images, UTM + "+5715", "own.tif", None, "expected metres upwards"),
    (heights_of_ground_images, UTM, None, "sea", "one of ellipsoid, geoid"),
    (heights_of_photographs, None, "own.tif", None, "give --crs"),
    (heights_of_photographs, None, None, "ellipsoid", "give --crs"),
    (heights_of_photographs, UTM, None, "geoid", "its vertical system"),
    (heights_of_photographs, UTM, "own.tif", "ellipsoid", "above the ellipsoid already"),
    (heights_of_photographs, UTM + "+5773", "own.tif", None, "above the geoid already"),
    (heights_of_photographs, UTM + "+5773", None, "ellipsoid", "projsync"),
    (heights_of_photographs, "EPSG:99", None, None, "EPSG:99"),
])  # fmt: skip
def test_what_contradicts_is_refused(choose, crs, geoid, heights, said):
    with pytest.raises(InputError, match=said):
        choose(crs, geoid, heights)


@pytest.mark.parametrize("crs, metres, said", [
    ("EPSG:4326", False, "is in degree"), ("EPSG:2263", True, "survey foot, heights are in metres"),
])  # fmt: skip
def test_cells_of_a_model_are_in_the_unit_of_the_heights(crs, metres, said):
    with pytest.raises(InputError, match=said):
        check_cells(heights_of_photographs(crs, None, None), metres)
    check_cells(heights_of_photographs("EPSG:2263", None, None), metres=False)
    check_cells(heights_of_photographs(None, None, None), metres=True)
    check_cells(heights_of_ground_images(UTM, None, None), metres=True)


def test_a_local_frame_has_no_geoid():
    assert not no_height_reference(None, None).words
    for options in (("own.tif", None), (None, "geoid")):
        with pytest.raises(InputError, match="local frame"):
            no_height_reference(*options)


def test_a_range_of_heights_contains_the_wanted_one_everywhere(geoid):
    reference = heights_of_ground_images(UTM, geoid, None)
    x, y = np.array([5.0e5, 5.4e5]), np.array([4.98e6, 5.0e6])
    low, high = reference.as_computed((100.0, 200.0), x, y)
    N = -reference.correction(x, y)
    assert abs(np.ptp(N)) > 1
    assert low == pytest.approx(100 + N.min()) and high == pytest.approx(200 + N.max())
    with pytest.raises(InputError, match="no height of the geoid at longitude 15.*covers the im"):
        reference.correction(np.array([1.0e6, 5e5]), y)
