"""Scanner files: what they mean, frames, and what is refused; the commands that read them."""

import csv
import io
import json
import sys
from collections import Counter

import cv2
import numpy as np
import pytest
import rasterio
from pushbroom_scenes import LINES, PIXELS, geodetic, locate, orbit, quaternions, satellite
from scanner_files import TEXT, write_scanner

from jaxbundle import cli
from jaxbundle.errors import InputError
from jaxbundle.geometry import ellipsoid as el
from jaxbundle.io.rasters.extent import Extent, image_extent
from jaxbundle.io.rasters.terrain_models import read_terrain
from jaxbundle.io.scanner.read import read_scanner
from jaxbundle.pushbroom.earth_frames import EarthOrientation, to_earth, turn_quaternions
from jaxbundle.pushbroom.surfaces import Ground
from jaxbundle.pushbroom.terrain import bilinear

PLACES = np.linspace(0, LINES - 1, 8), np.linspace(0, PIXELS - 1, 5)
EPOCH = "2016-06-22T04:00:12.25"


def assert_same_image(image, atol=1e-6):
    expected = locate(satellite(), Ground(), *PLACES)
    np.testing.assert_allclose(locate(image, Ground(), *PLACES), expected, atol=atol)


def test_a_file_is_the_image_it_describes(tmp_path):
    scanner = read_scanner(write_scanner(tmp_path))
    assert scanner.name == "test" and scanner.earth == el.WGS84
    assert_same_image(scanner.image)


@pytest.mark.parametrize("frame", ["GCRF", "TEME"])
def test_inertial_tables(tmp_path, frame):
    """The tables turned back to an inertial frame describe the same image."""
    eop = EarthOrientation(-0.2, 0.1, 0.4)
    t = np.arange(-6.0, 11.0)
    R = to_earth(frame, EPOCH, t, eop)
    P, V = orbit(t)
    back = np.swapaxes(R, 1, 2)
    P = np.einsum("nij,nj->ni", back, P)
    rows = np.arange(-1, 5.5, 0.1)
    turn = np.swapaxes(to_earth(frame, EPOCH, rows, eop), 1, 2)
    q = turn_quaternions(turn, quaternions(rows))
    text = TEXT.replace('csv"\n', f'csv"\nframe = "{frame}"\n')
    text += "[earth_orientation]\nut1_utc = -0.2\nx_pole = 0.1\ny_pole = 0.4\n"
    assert_same_image(read_scanner(write_scanner(tmp_path, text, (P, 0 * V), q)).image)


def test_an_orbit_instead_of_a_table(tmp_path):
    circle = (
        'span = [-6, 11]\ncircle = { height = 505000.0, inclination = 97.4, '
        f"node = {float(np.degrees(1.9))!r}, argument = {float(np.degrees(0.1))!r} }}\n"
    )
    text = TEXT.replace('table = "positions.csv"\n', circle)
    image = read_scanner(write_scanner(tmp_path, text)).image
    assert_same_image(image)
    assert image.trajectory.position.times[-1] == 11  # the end of the span is a row


BROKEN = {
    "misspelt section": ("[optics]", "[optic]", ["[optic]", "did you mean 'optics'"]),
    "misspelt key": ("period", "perod", ["[times]", "'perod'", "did you mean 'period'"]),
    "misspelt parameter": ("K1 =", "k11 =", ["[optics]", "k11", "K1"]),
    "no table": ("positions.csv", "nowhere.csv", ["[position]", "no such file"]),
    "unknown frame": ('attitude.csv"', 'attitude.csv"\nframe = "orbt"', ["'orbt'", "'orbit'"]),
    "no principal distance": ("c = 700.0", "", ["[optics]", "c is missing"]),
    "negative period": ("period = ", "period = -", ["[times]", "positive"]),
    "not a number": ("lines = 600", 'lines = "many"', ["[scanner]", "lines is 'many'"]),
    "too short": ("lines = 600", "lines = 900", ["attitude.csv: image line 810", "outside"]),
    "too long": ("lines = 600", "lines = 1000000000000000", ["[scanner]", "10000000"]),
    "gap": ('ude.csv"', 'ude.csv"\ngap = 0.05', ["attitude.csv, line 13: image line 0", "0.1 s"]),
    "no gap": ('ude.csv"', 'ude.csv"\ngap = -1', ["[attitude]", "gap is -1", "positive"]),
    "local frame": ('ions.csv"', 'ions.csv"\nframe = "local"', ["[position]", 'earth = "local"']),
    "interpolation": ('ude.csv"', 'ude.csv"\ninterpolation = "slurp"', ["did you mean 'slerp'"]),
    "angles": ("yaw", "jaw", ["[mounting]", "'jaw'", "'yaw'"]),
    "a key of orbits": ('ions.csv"', 'ions.csv"\nspan = [0, 1]', ["[position]", "key 'span'"]),
    "two ways of times": ("period", 'table = "t.csv"\nperiod', ["[times]", "key 'period'"]),
    "fraction": ('ions.csv"', 'ions.csv"\norder = 7.9', ["[position]", "order is 7.9", "whole"]),
    "misspelt circle": (
        'table = "positions.csv"', "circle = { height = 5e5, inclinaton = 98 }\nspan = [-6, 11]",
        ["[position]", "circle", "did you mean 'inclination'"],
    ),
    "circle in kilometres": (
        'table = "positions.csv"', "circle = { height = 505 }\nspan = [-6, 11]",
        ["[position]: circle: height is 505;", "is it in kilometres?"],
    ),
    "no circle": ('table = "positions.csv"', "circle = 5\nspan = [-6, 11]", ["circle is 5"]),
    "no elements": ('table = "positions.csv"', "tle = [1, 2]\nspan = [0, 9]", ["tle", "quotes"]),
    "no width": (
        TEXT[TEXT.index("model =") : TEXT.index("[mount")],
        "across = [0, 1]\nalong = [0]\nhalf = 0\n", ["[optics]", "half is 0"],
    ),
}  # fmt: skip


@pytest.mark.parametrize("case", BROKEN)
def test_what_is_wrong_in_a_file(tmp_path, case):
    old, new, words = BROKEN[case]
    assert old in TEXT
    path = write_scanner(tmp_path, TEXT.replace(old, new, 1))
    with pytest.raises(InputError) as refused:
        read_scanner(path)
    for word in words:
        assert word in str(refused.value), refused.value


CIRCLE = 'table = "positions.csv"', "circle = { height = 5e5 }\nspan = [0, 9]"


@pytest.mark.parametrize("earth, old, new, words", [
    ('"local"', 'ude.csv"', 'ude.csv"\nframe = "orbit"', "frame is 'orbit', earth is local"),
    ('"local"', *CIRCLE, r"\[position\]: circle: an orbit is about the Earth"),
    ("[3396190, 3396190, 3376200]", *CIRCLE, r"\[position\]: circle: an orbit is about the Earth"),
])  # fmt: skip
def test_an_orbit_needs_the_earth(tmp_path, earth, old, new, words):
    """In a local frame the direction from its origin is no vertical; of Mars GM is another."""
    elsewhere = TEXT.replace('name = "test"', f"earth = {earth}")
    with pytest.raises(InputError, match=words):
        read_scanner(write_scanner(tmp_path, elsewhere.replace(old, new)))


KINDS = "Community Sensor Model (.json)", "DIMAP", "DigitalGlobe (.xml, .imd)"


@pytest.mark.parametrize("source", ["", "none.xml", "image.tif", "other.toml", "folder.xml", None])
def test_a_wrong_source_is_said_with_the_kinds_there_are(tmp_path, command, source):
    """By file and key: which kinds of product a scanner file may refer to."""
    (tmp_path / "folder.xml").mkdir()
    for name in ("image.tif", "other.toml"):
        (tmp_path / name).touch()
    path, key = tmp_path / "scanner.toml", f'source = "{source}"' if source is not None else ""
    path.write_text(f"[scanner]\n{key}\n")
    told = command("pushbroom", "locate", path)
    where = f"{path}, [scanner]: source = " if key else f"{path}: the section [times] is missing"
    assert told.status == 2 and told.err.startswith(f"jaxbundle: {where}"), told
    assert all(kind in told.err for kind in (*KINDS, "source")), told


@pytest.mark.parametrize("name", ["image.tif", "folder.json", "object.json", "flight.toml"])
def test_what_is_no_scanner_image(tmp_path, command, name):
    (tmp_path / "folder.json").mkdir()
    (tmp_path / "image.tif").touch()
    (tmp_path / "object.json").write_text('{"a": 1}')
    (tmp_path / "flight.toml").write_text("[scanner]\nlines = 9\n[track]\nheight = 5e5\n")
    told = command("pushbroom", "locate", tmp_path / name)
    assert told.status == 2 and told.err.startswith(f"jaxbundle: {tmp_path / name}"), told
    assert ("simulate" if name == "flight.toml" else "expected") in told.err, told


@pytest.mark.parametrize("name", ["folder", "text.csv"])
def test_what_is_no_raster(tmp_path, command, name):
    (tmp_path / "folder").mkdir()
    (tmp_path / "text.csv").write_text("a,b\n1,2\n")
    scanner, out = write_scanner(tmp_path), tmp_path / "map.tif"
    told = command("pushbroom", "correct", scanner, tmp_path / name, "--out", out)
    assert told.status == 2 and "expected a raster, such as a GeoTIFF" in told.err, told
    assert told.err.startswith(f"jaxbundle: {tmp_path / name}: ") and not out.exists()


@pytest.mark.parametrize("column, value, words", [
    (0, "-0.9", ["attitude.csv, line 4", "twice"]), (0, "-5", ["line 4", "sort"]),
    (1, "0.5", ["line 4", "length"]), (1, "x", ["line 4", "q0"]),
])  # fmt: skip
def test_what_is_wrong_in_a_table(tmp_path, column, value, words):
    path = write_scanner(tmp_path)
    lines = (tmp_path / "attitude.csv").read_text().splitlines()
    cells = lines[3].split(",")
    cells[column] = value
    lines[3] = ",".join(cells)
    (tmp_path / "attitude.csv").write_text("\n".join(lines))
    with pytest.raises(InputError) as refused:
        read_scanner(path)
    for word in words:
        assert word in str(refused.value)


def test_positions_in_kilometres(tmp_path):
    t = np.arange(-6.0, 11.0)
    P, V = orbit(t)
    path = write_scanner(tmp_path, positions=(P / 1000, V / 1000))
    with pytest.raises(InputError, match="positions.csv, line 2: .* from the centre .*kilometres"):
        read_scanner(path)


def test_degrees_read_as_radians_are_refused(tmp_path):
    """More than a turn: 12° are 1.9 turns if they are taken as radians."""
    in_radians = TEXT.replace('name = "test"', 'name = "test"\nangle_unit = "rad"')
    roll = f"roll = {float(np.degrees(-0.02))!r}"
    with pytest.raises(InputError, match="roll is -12 rad.*are these degrees"):
        read_scanner(write_scanner(tmp_path, in_radians.replace(roll, "roll = -12.0")))


def test_a_camera_that_looks_up(tmp_path, command):
    """What the middle ray misses is said; figures of it are not known."""
    text = TEXT.replace(f"roll = {float(np.degrees(-0.02))!r}", "roll = 180")
    told = command("pushbroom", "info", write_scanner(tmp_path, text), "--json", "-")
    assert told.status == 0 and "the middle of the image misses the ground; check att" in told.err
    assert json.loads(told.out)["incidence"] is None


def run(monkeypatch, capsys, *arguments):
    """Exit status, standard output and error of a command, in this process."""
    monkeypatch.setattr(sys, "argv", ["jaxbundle", "pushbroom", *map(str, arguments)])
    with pytest.raises(SystemExit) as ended:
        cli.main()
    return ended.value.code or 0, *capsys.readouterr()


def test_there_and_back_by_the_commands(tmp_path, monkeypatch, capsys):
    scanner = write_scanner(tmp_path)
    (tmp_path / "places.csv").write_text("id,line,pixel\na,10.25,7\nb,599,399.4\n")
    places = ("--points", tmp_path / "places.csv")
    ground = tmp_path / "ground.csv"
    assert run(monkeypatch, capsys, "locate", scanner, *places, "--height", 200, "--csv", ground)[
        0
    ] == 0
    rows = list(csv.DictReader(io.StringIO(ground.read_text())))
    assert [row["id"] for row in rows] == ["a", "b"]
    assert all(abs(float(row["height"]) - 200) < 1e-6 for row in rows)
    # the last table is what `locate` itself writes, a row without a point in it
    whole = tuple(rows[0])
    missed = {"id": "c", "line": "3", "pixel": "3", "status": "no terrain there"}
    for names in (("id", "X", "Y", "Z"), ("id", "longitude", "latitude", "height"), whole):
        lines = [",".join(row.get(n, "") for n in names) for row in rows]
        if names is whole:
            lines.insert(1, ",".join(missed.get(n, "") for n in names))
        (tmp_path / "points.csv").write_text(",".join(names) + "\n" + "\n".join(lines) + "\n")
        status, out, err = run(
            monkeypatch, capsys, "project", scanner, "--points", tmp_path / "points.csv",
            "--json", "-",
        )  # fmt: skip
        assert ("points.csv, line 3: no point" in err) == (names is whole)
        found = json.loads(out)["rows"]
        assert status == 0 and [row["count"] for row in found] == [1, 1]
        np.testing.assert_allclose([row["line"] for row in found], [10.25, 599], atol=1e-6)
        np.testing.assert_allclose([row["pixel"] for row in found], [7, 399.4], atol=1e-6)


def test_what_the_commands_refuse(tmp_path, monkeypatch, capsys):
    scanner = write_scanner(tmp_path)
    off, gone = tmp_path / "off.csv", tmp_path / "gone.csv"
    off.write_text("line,pixel\n3,400\n")  # all of them: one of several is told in its row
    north, lon = tmp_path / "north.csv", tmp_path / "lon.csv"
    north.write_text("longitude,latitude,height\n1,2,3\n1,95,3\n")
    lon.write_text("lon,lat,height\n1,2,3\n")
    gone.write_text("X,Y,Z\n6378137,0,0\n6378137,0,1\n")  # as many as there and back
    scene = tmp_path / "image.tif"
    cv2.imwrite(str(scene), np.zeros((LINES, PIXELS), np.uint8))
    cases = [
        (["locate", scanner, "--points", off], ["off.csv, line 2", "pixel 400", "399.5"]),
        (["locate", scanner, "--grid", "few"], ["--grid 'few'", "11x11"]),
        (["locate", scanner, "--height", "7e6", "--grid", "1x2"], ["misses the surface", "2 of 2"]),
        (["project", scanner, "--points", gone], ["gone.csv, line 2", "not", "in the image"]),
        (["project", scanner, "--points", tmp_path / "none.csv"], ["none.csv", "no such file"]),
        (["project", scanner, "--points", north], ["north.csv, line 3", "latitude 95", "90°"]),
        (["project", scanner, "--points", lon], ["lon.csv", "X, Y, Z", "longitude"]),
        (["locate", scanner, "--height", "nan"], ["--height nan", "finite"]),
        (["correct", scanner, scene, "--out", tmp_path / "m.tif", "--spacing", 30],
         ["--spacing 30", "larger than the whole image", "degrees"]),
    ]
    for arguments, words in cases:
        status, out, err = run(monkeypatch, capsys, *arguments)
        assert status == 2 and out == "" and len(err.splitlines()) == 1, err
        for word in words:
            assert word in err or word == "not", err


def write_raster(path, heights, crs, transform):
    with rasterio.open(
        path, "w", driver="GTiff", height=heights.shape[0], width=heights.shape[1], count=1,
        dtype="float64", crs=crs, transform=rasterio.transform.Affine(*transform), nodata=-9999,
    ) as target:  # fmt: skip
        target.write(heights, 1)
    return path


@pytest.mark.further
def test_terrain_rasters(tmp_path, monkeypatch, capsys):
    """Heights of a plane over longitude and latitude; the same in UTM; a model elsewhere."""
    scanner = write_scanner(tmp_path)
    X = locate(satellite(), Ground(), *PLACES)
    longitude, latitude, _ = (np.degrees(v) for v in geodetic(tuple(X)))
    west, north = float(longitude.min()) - 0.05, float(latitude.max()) + 0.05
    size = int((latitude.max() - latitude.min() + 0.1) / 0.01), int(np.ptp(longitude) / 0.01 + 10)
    column, row = np.meshgrid(np.arange(size[1]) + 0.5, np.arange(size[0]) + 0.5)
    slope = 100 + 3 * column - 2 * row
    path = write_raster(tmp_path / "dem.tif", slope, "EPSG:4326", (0.01, 0, west, 0, -0.01, north))
    status, out, _ = run(monkeypatch, capsys, "locate", scanner, "--dem", path, "--grid", "3x3")
    assert status == 0
    for found in csv.DictReader(io.StringIO(out)):
        x = (float(found["longitude"]) - west) / 0.01
        y = (north - float(found["latitude"])) / 0.01
        assert abs(float(found["height"]) - (100 + 3 * x - 2 * y)) < 1e-4
    elsewhere = write_raster(tmp_path / "far.tif", slope, "EPSG:4326", (0.01, 0, 170, 0, -0.01, 0))
    status, out, err = run(monkeypatch, capsys, "locate", scanner, "--dem", elsewhere,
                           "--grid", "3x3")  # fmt: skip
    assert status == 2 and "far.tif" in err and "covers the image" in err
    # only what the image can see is read, though its longitudes be a turn away
    file = read_scanner(scanner)
    extent = image_extent(file.image, file.earth)
    turned = extent._replace(west=extent.west + 360, east=extent.east + 360)
    whole, cut = (read_terrain(path, el.WGS84, part) for part in (None, turned))
    assert cut.heights.size < 0.9 * whole.heights.size
    np.testing.assert_allclose(
        *(locate(file.image, t, *PLACES) for t in (whole, cut)), atol=1e-6
    )
    bare = write_raster(tmp_path / "bare.tif", slope, None, (0.01, 0, 0, 0, -0.01, 0))
    with pytest.raises(InputError, match="no coordinate system"):
        read_terrain(bare, el.WGS84)
    with pytest.raises(InputError, match="nowhere.tif"):
        read_terrain(tmp_path / "nowhere.tif", el.WGS84)
    utm = write_raster(tmp_path / "utm.tif", np.full((60, 50), 250.0), "EPSG:32633",
                       (100, 0, 5e5, 0, -100, 5.5e6))  # fmt: skip
    terrain = read_terrain(utm, el.WGS84)
    heights = np.asarray(terrain.heights)
    assert np.allclose(heights[np.isfinite(heights)], 250) and terrain.step[1] < 0
    assert abs(np.degrees(terrain.origin[1]) - 49.65) < 0.01


@pytest.mark.further
def test_ground_behind_a_place_without_height(tmp_path, monkeypatch, capsys):
    """Flat land seen obliquely over a sea without height, and a high mountain elsewhere."""
    mounting = TEXT[TEXT.index("[mounting]") :]
    scanner = write_scanner(tmp_path, TEXT.replace(mounting, "[mounting]\nroll = 40.0\n"))
    file = read_scanner(scanner)
    X = locate(file.image, Ground(), *PLACES)
    camera = np.array(file.image.trajectory.position.values)[:1].T
    longitude, latitude, _ = (np.degrees(v) for v in geodetic(tuple(X)))
    beneath = float(np.degrees(geodetic(tuple(camera))[0])[0])
    west, north = float(longitude.min()) - 0.05, float(latitude.max()) + 0.05
    size = int((latitude.max() - latitude.min() + 0.1) / 0.01), int(np.ptp(longitude) / 0.01 + 10)
    column = np.tile(np.arange(size[1]) + 0.5, (size[0], 1))
    middle = (float(longitude.mean()) - west) / 0.01
    sea = (column < middle) == (beneath < longitude.mean())
    heights = np.where(sea, -9999, 100.0)
    heights[0, 0 if sea[0, -1] else -1] = 4000.0
    transform = 0.01, 0, west, 0, -0.01, north
    path = write_raster(tmp_path / "dem.tif", heights, "EPSG:4326", transform)
    status, out, err = run(monkeypatch, capsys, "locate", scanner, "--dem", path, "--grid", "3x31")
    rows = list(csv.DictReader(io.StringIO(out)))
    assert status == 0 and "dem.tif" in err
    for row in rows:
        if row["status"] != "no terrain there":
            assert abs(float(row["height"]) - 100) < 1e-6
            # rays come down from 4000 m at about 45°
            shore = abs(float(row["longitude"]) - west - 0.01 * middle) * 111
            assert shore < 7 if "without height" in row["status"] else shore > 2
    counted = Counter(row["status"] for row in rows)
    assert min(counted.values()) >= 3 and len(counted) == 3


def test_terrain_across_180(tmp_path):
    """The seam of a model of the whole Earth, and a projected model that lies across."""
    row, column = np.mgrid[:180, :360]
    heights = np.sin(np.radians(column + 0.5)) * 100 + row
    path = write_raster(tmp_path / "all.tif", heights, "EPSG:4326", (1, 0, -180, 0, -1, 90))
    for west in (177.0, -183.0):
        cut = read_terrain(path, el.WGS84, Extent(west, 10.0, west + 5, 14.0))
        assert cut.heights.shape[1] < 15
        place = el.earth_fixed(el.WGS84, (np.radians(180.0), np.radians(12.5), 0.0))
        x, y, _ = cut.grid(place)
        assert float(bilinear(cut.heights, x, y)) == pytest.approx(77, abs=1e-9)
    utm = write_raster(tmp_path / "utm.tif", np.full((60, 50), 250.0), "EPSG:32601",
                       (800, 0, 143753, 0, -800, 66422))  # fmt: skip
    heights = np.asarray(read_terrain(utm, el.WGS84).heights)
    assert heights.size < 2 * 60 * 50 and np.nanmax(np.abs(heights - 250)) < 1e-6
    with pytest.raises(InputError, match="utm.tif: the model has .* the image looks at .*covers"):
        read_terrain(utm, el.WGS84, Extent(10.0, 10.0, 12.0, 12.0))
