"""`--geoid`: terrain models of orthometric heights, and places off the image, by commands."""

import csv
import io
import sys
from pathlib import Path

import numpy as np
import pyproj
import pytest
import rasterio
from rpc_scenes import made_up
from scanner_files import write_scanner

from jaxbundle import cli
from jaxbundle.cli.pushbroom.shared import surface_of
from jaxbundle.errors import InputError
from jaxbundle.geometry.ellipsoid import WGS84
from jaxbundle.io.rasters.geoid import add_geoid, undulations
from jaxbundle.io.scanner.rpc import write_rpc
from jaxbundle.pushbroom.terrain import make_terrain

FLIGHT = Path(__file__).parents[2] / "examples" / "line_scanner" / "flight.toml"
RPC = made_up(longitude_offset=12.3)


@pytest.fixture
def run(monkeypatch, capsys):
    def run(*arguments):
        monkeypatch.setattr(sys, "argv", ["jaxbundle", "pushbroom", *map(str, arguments)])
        with pytest.raises(SystemExit) as ended:
            cli.main()
        return ended.value.code or 0, *capsys.readouterr()

    return run


def write_grid(path, function, west, north, step, columns, rows, crs="EPSG:4326"):
    """A raster of a function of longitude and latitude (or x, y) at the centres of its pixels."""
    x, y = np.meshgrid(west + step * np.arange(columns), north - step * np.arange(rows))
    transform = rasterio.transform.Affine(step, 0, west - step / 2, 0, -step, north + step / 2)
    with rasterio.open(
        path, "w", driver="GTiff", width=columns, height=rows, count=1, dtype="float64", crs=crs,
        transform=transform,
    ) as target:  # fmt: skip
        target.write(function(x, y)[None])
    return path


def plane(longitude, latitude):
    """Bilinear, so that no interpolation errs."""
    return 40 + 0.5 * (longitude - 12) - 0.25 * (latitude + 23) + 0.1 * longitude * latitude


def test_undulations(tmp_path):
    """Of a raster, also seen a turn away, and of a grid of PROJ by its name."""
    path = write_grid(tmp_path / "own_geoid.tif", plane, 10, -20, 0.25, 25, 25)
    longitude, latitude = np.array([10.0, 12.3, 15.99]), np.array([-20.1, -23.456, -26.0])
    expected = plane(*np.meshgrid(longitude, latitude))
    np.testing.assert_allclose(undulations(path, longitude, latitude), expected, atol=1e-9)
    np.testing.assert_allclose(undulations(path, longitude - 360, latitude), expected, atol=1e-9)
    assert np.isnan(undulations(path, np.array([10.0, 16.3]), latitude)[:, 1]).all()
    pyproj.datadir.append_data_dir(str(tmp_path))
    named = undulations("own_geoid.tif", longitude, latitude)
    np.testing.assert_allclose(named, expected, atol=1e-6)
    with pytest.raises(InputError, match="no_geoid.tif: there is no such file, and PROJ"):
        undulations("no_geoid.tif", longitude, latitude)


def test_terrain_above_the_geoid(tmp_path):
    path = write_grid(tmp_path / "geoid.tif", plane, 10, -20, 0.25, 25, 25)
    H = np.random.default_rng(0).uniform(0, 500, (4, 5))
    H[1, 2] = np.nan
    origin, step = np.radians([12.0, -22.0]), np.radians([0.01, -0.02])
    found = add_geoid(make_terrain(H, origin, step, WGS84), path)
    longitude, latitude = np.meshgrid(12 + 0.01 * np.arange(5), -22 - 0.02 * np.arange(4))
    np.testing.assert_allclose(found.heights, H + plane(longitude, latitude), atol=1e-9)
    away = make_terrain(H, np.radians([15.97, -22.0]), step, WGS84)
    with pytest.raises(InputError, match="geoid.tif: no height of the geoid at longitude 16.01"):
        add_geoid(away, path)
    with pytest.raises(InputError, match="local frame has no geoid"):
        add_geoid(make_terrain(H, (0, 0), (1, 1), None), path)


def test_every_command_with_terrain_takes_a_geoid(tmp_path, run):
    write_rpc(tmp_path / "a.txt", RPC)
    (tmp_path / "places.csv").write_text("line,sample\n2500,2000\n")
    level = lambda x, y: 250.0 + 0 * x
    dem = write_grid(tmp_path / "dem.tif", level, 12.1, -23.2, 0.01, 41, 41)
    geoid = write_grid(tmp_path / "geoid.tif", plane, 10, -20, 0.25, 25, 25)
    terrain = surface_of(WGS84, None, dem, RPC, geoid)
    h = interpolated(terrain, 12.25, -23.4)
    assert h == pytest.approx(250 + plane(12.25, -23.4), abs=1e-6)
    world = write_grid(tmp_path / "world.tif", level, -179.5, 89.5, 1.0, 360, 180)
    scanner = write_scanner(tmp_path)
    image = write_grid(tmp_path / "image.tif", level, 0, 0, 1.0, 400, 600, None)
    orbit = FLIGHT.read_text()
    (tmp_path / "flight.toml").write_text(orbit)
    out = tmp_path / "out.tif"
    for arguments in (
        ["rpc", "apply", tmp_path / "a.txt", "--points", tmp_path / "places.csv"],
        ["locate", scanner], ["accuracy", scanner, "--truth", scanner],
        ["correct", scanner, image, "--out", out],
        ["simulate", tmp_path / "flight.toml", "--out", tmp_path / "flight"],
    ):  # fmt: skip
        status, _, err = run(*arguments, "--geoid", geoid)
        assert status == 2 and "--geoid" in err and "--dem" in err, arguments
        status, _, err = run(*arguments, "--dem", world, "--geoid", "no_geoid.tif")
        assert status == 2 and "--geoid no_geoid.tif: there is no such file" in err, err
    assert not out.exists() and not (tmp_path / "flight").exists()


def interpolated(terrain, longitude, latitude):
    """The height of the node at a place."""
    column, row = (
        (np.radians(v) - terrain.origin[k]) / terrain.step[k]
        for k, v in enumerate((longitude, latitude))
    )
    assert abs(column - round(column)) < 1e-6 and abs(row - round(row)) < 1e-6
    return float(terrain.heights[round(row), round(column)])


def test_places_off_the_image_are_told_row_by_row(tmp_path, run):
    scanner = write_scanner(tmp_path)
    (tmp_path / "places.csv").write_text("id,line,pixel\na,10,20\nb,600,20\nc,10,-1\nd,599.5,0\n")
    arguments = ["locate", scanner, "--points", tmp_path / "places.csv"]
    status, out, err = run(*arguments)
    rows = list(csv.DictReader(io.StringIO(out)))
    assert status == 0 and [row["id"] for row in rows] == ["a", "b", "c", "d"]
    assert [row["status"] for row in rows] == ["found", "off the image", "off the image", "found"]
    assert [bool(row["X"]) for row in rows] == [True, False, False, True]
    assert len(err.splitlines()) == 1
    for word in ("places.csv, line 3", "line 600 is off the image", "(2 of 4 points)"):
        assert word in err
    (tmp_path / "places.csv").write_text("line,pixel\n10,400\n")
    status, out, err = run(*arguments)
    assert status == 2 and out == "" and "pixel 400 is off the image" in err
