"""Systems and grids of maps: across 180°, invalid maps, maps that are too large."""

import numpy as np
import pytest

from jaxbundle.commands.corrected_maps import _fingerprint
from jaxbundle.errors import InputError
from jaxbundle.geometry.ellipsoid import WGS84, earth_fixed
from jaxbundle.io.rasters.maps import MapGrid, MapSystem, contiguous, grid_around
from jaxbundle.pushbroom import Ground

LATTICE = np.meshgrid(179.7 + 0.02 * np.arange(33), -16 + 0.02 * np.arange(33))
X = np.array(earth_fixed(WGS84, (*np.radians(LATTICE), np.zeros((33, 33)))))


@pytest.mark.parametrize("crs, turn", [(None, 360), ("EPSG:4326", 360), ("EPSG:4807", 400)])
def test_longitudes_go_on_beyond_180(crs, turn):
    system = MapSystem(WGS84, crs)
    x, y = system.from_ground(X)
    # the seam of longitudes from Paris, in grads, is elsewhere
    assert (np.ptp(x) > 0.99 * turn) == (turn == 360)
    x = contiguous(system, x)
    assert np.ptp(x) == pytest.approx(0.64 * turn / 360, rel=1e-3)
    grid = grid_around(x, y, 0.01 * turn / 360)
    assert 64 <= grid.columns <= 68 and 64 <= grid.rows <= 68
    nodes = system.nodes(Ground(), x, y)
    # the fourth system has its own ellipsoid: some hundred metres
    assert np.abs(nodes.X - X).max() < (1e-6 if turn == 360 else 500)


def test_a_projected_system_has_an_edge():
    with pytest.raises(InputError, match="EPSG:3857.*both sides"):
        system = MapSystem(WGS84, "EPSG:3857")
        contiguous(system, system.from_ground(X)[0])
    system = MapSystem(WGS84, "EPSG:3832")
    x = contiguous(system, system.from_ground(X)[0])
    assert np.ptp(x) == pytest.approx(6378137 * np.radians(0.64), rel=1e-6)


@pytest.mark.parametrize("crs, words", [
    ("EPSG:4978", "Geocentric"), ("EPSG:5773", "Vertical"), ("EPSG:0", "EPSG:0"),
])  # fmt: skip
def test_no_system_of_maps(crs, words):
    with pytest.raises(InputError, match=words):
        MapSystem(WGS84, crs)


@pytest.mark.parametrize("scanner, part", [
    ("a.IMD", "a.ATT"), ("a.imd", "a.eph"), ("a.tif", "a_RPC.TXT"), ("a.toml", "a.csv"),
])  # fmt: skip
def test_the_blocks_of_a_map_depend_on_all_that_is_read(tmp_path, scanner, part):
    for name in (scanner, part, "image.tif"):
        (tmp_path / name).write_text('table = "a.csv"')
    of_map = lambda: _fingerprint(
        tmp_path / scanner, tmp_path / "image.tif", None, None, MapGrid(0.0, 0.0, 1.0, 2, 2), None
    )
    before = of_map()
    (tmp_path / part).write_text("another")
    assert of_map() != before


def test_a_map_that_is_too_large():
    x, y = np.array([0.0, 1.0]), np.array([0.0, 2.0])
    for size, most in ((1e-10, np.inf), (1e-3, 1e6)):
        with pytest.raises(InputError, match="--spacing .* larger"):
            grid_around(x, y, size, most)


@pytest.mark.parametrize("latitude, system", [(89.98, "EPSG:32661"), (-89.5, "EPSG:32761")])
def test_a_map_of_a_pole_needs_its_system(latitude, system):
    """In longitude and latitude it was a map without a pixel of the image."""
    from jaxbundle.io.rasters.maps import check_away_from_poles
    from jaxbundle.photographs.places import utm_system

    y = np.array([[latitude, latitude - np.sign(latitude) * 0.1]])
    with pytest.raises(InputError, match=f"at the .* Pole.*give --crs {system}"):
        check_away_from_poles(MapSystem(WGS84, None), y)
    check_away_from_poles(MapSystem(WGS84, None), 0.9 * y)
    check_away_from_poles(MapSystem(WGS84, system), 1e5 * y)
    assert utm_system(latitude, 20.0) == system and utm_system(83.0, 20.0) == "EPSG:32634"
