"""Images at and near a pole, and across the date line: what holds there, and what is refused."""

import jax.numpy as jnp
import numpy as np
import pytest
import rasterio

from jaxbundle.commands.scanner_inputs import surface_of
from jaxbundle.errors import InputError
from jaxbundle.geometry.ellipsoid import WGS84, earth_fixed, geodetic
from jaxbundle.io.rasters.extent import image_extent, pole_in_image
from jaxbundle.pushbroom import locate_points
from jaxbundle.pushbroom.flight import Flight, true_image
from jaxbundle.pushbroom.scanner import FocalLine
from jaxbundle.pushbroom.surfaces import Height
from jaxbundle.pushbroom.terrain import Terrain

LINES, PIXELS = 300, 200
SOME_LINES, SOME_PIXELS = np.array([0.0, 150.0, 299.0]), np.array([10.0, 100.0, 190.0])


def image_between(start, end):
    """200 km of swath from 505 km, from longitude, latitude to longitude, latitude."""
    ends = [np.array([float(v) for v in earth_fixed(WGS84, (*np.radians(p), 505e3))])
            for p in (start, end)]  # fmt: skip
    optics = FocalLine(jnp.array([300.0] + 10 * [0.0]), jnp.float64(0.29),
                       jnp.float64((PIXELS - 1) / 2), jnp.float64(0.0))  # fmt: skip
    track = {"start": ends[0], "end": ends[1], "centre": np.zeros(3)}
    return true_image(Flight(LINES, PIXELS, 0.014, optics, track))


PLACES = {
    "North Pole": ((10.0, 89.2), (-170.0, 89.3)), "South Pole": ((10.0, -89.2), (-170.0, -89.3)),
    "beside": ((10.0, 87.6), (14.0, 87.0)), "date line": ((178.6, 10.0), (180.4, 10.4)),
}  # fmt: skip


@pytest.mark.parametrize("where", PLACES)
def test_a_pole_in_the_image_is_found(where):
    """By the longitudes around the border; the pole itself is then inside."""
    image = image_between(*PLACES[where])
    found = pole_in_image(image, WGS84)
    assert found == (where if "Pole" in where else None)
    extent = image_extent(image, WGS84)
    assert (extent is None) == (where != "date line")
    if extent is not None:
        # one range of longitudes, beyond 180°
        assert extent.west < 178.6 and 180.4 < extent.east < 182


def polar_model(path):
    """Heights 100 + x/1000 + y/2000 in a polar system, 1600 km wide about the pole."""
    y, x = 800e3 - 4e3 * np.indices((400, 400))
    heights = 100 - x / 1e3 + y / 2e3
    place = rasterio.Affine(4e3, 0, -802e3, 0, -4e3, 802e3)
    with rasterio.open(path, "w", driver="GTiff", width=400, height=400, count=1, dtype="float32",
                       crs="EPSG:3995", transform=place) as to:  # fmt: skip
        to.write(heights.astype("float32")[None])
    return path


def test_terrain_at_a_pole_is_refused_and_a_height_is_not(tmp_path):
    path, at_pole = polar_model(tmp_path / "polar.tif"), image_between(*PLACES["North Pole"])
    with pytest.raises(InputError, match=r"polar.tif: the image shows the North Pole.*--height"):
        surface_of(WGS84, None, path, at_pole)
    X = np.asarray(locate_points(at_pole, Height(50.0, WGS84), SOME_LINES, SOME_PIXELS))
    np.testing.assert_allclose(np.asarray(geodetic(WGS84, tuple(X))[2]), 50.0, atol=1e-6)


@pytest.mark.further
def test_polar_terrain_beside_the_pole(tmp_path):
    path = polar_model(tmp_path / "polar.tif")
    image = image_between(*PLACES["beside"])
    surface = surface_of(WGS84, None, path, image)
    assert isinstance(surface, Terrain)
    X = np.asarray(locate_points(image, surface, SOME_LINES, SOME_PIXELS))
    longitude, latitude, h = (np.asarray(v) for v in geodetic(WGS84, tuple(X)))
    from pyproj import Transformer

    to_map = Transformer.from_crs("EPSG:4326", "EPSG:3995", always_xy=True)
    x, y = to_map.transform(np.degrees(longitude), np.degrees(latitude))
    # the model in its own system; cells of 4 km, twice interpolated, of a plane
    np.testing.assert_allclose(h, 100 + x / 1e3 + y / 2e3, atol=0.5)
