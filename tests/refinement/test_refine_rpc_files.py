"""Refine files with RPC images: results as coefficients, stated errors, and what is refused."""

import dataclasses
import json
import sys

import numpy as np
import pytest
import rasterio
from rpc_block import SIGMA_CONTROL, block
from typer.testing import CliRunner

from jaxbundle import cli
from jaxbundle.cli.app import app
from jaxbundle.cli.pushbroom import refine as _refine  # noqa: F401
from jaxbundle.errors import InputError
from jaxbundle.geometry.ellipsoid import WGS84, geodetic
from jaxbundle.io.scanner.refinement import read_refinement
from jaxbundle.io.scanner.rpc import StatedErrors, read_rpc, read_stated_errors, write_rpc
from jaxbundle.io.text.csv_tables import read_csv, write_csv
from jaxbundle.pushbroom.rpc.polynomials import project_points
from jaxbundle.refinement import HELD, Freedom
from jaxbundle.system.rasters import open_plain

TEXT = """
[refine]
points = "points.csv"
observations = "observations.csv"
sigma = 0.4
snooping = "baarda"
dem = "dem.tif"
dem_sigma = 300.0

[images]
A = "a.tif"
B = "b.RPB"
C = "c_RPC.TXT"

[unknowns]
bias_degree = 1
bias = [6.0, 0.8]
"""


@pytest.fixture(scope="module")
def scene():
    return block(rpc=3, scanner=0, points=24, control=6, checks=0, degree=1, rays=3)


@pytest.fixture
def folder(tmp_path, scene):
    write_files(tmp_path, scene)
    return tmp_path


def write_files(folder, scene):
    """The scene as files: a raster with tags, RPB and text, tables, a terrain model."""
    (_, points, observations), _ = scene.draw(np.random.default_rng(2))
    profile = {"driver": "GTiff", "height": 4000, "width": 4000, "count": 1, "dtype": "uint8"}
    with open_plain(folder / "a.tif", "w", compress="deflate", sparse_ok=True, **profile):
        pass
    for one, name in zip(scene.images, ("a.tif", "b.RPB", "c_RPC.TXT")):
        write_rpc(folder / name, one.image.rpc)
    known = np.isfinite(points.X).all(1)
    place = np.full((len(points), 3), np.nan)
    place[known] = np.stack(geodetic(WGS84, tuple(points.X[known].T)), 1)
    place[:, :2] = np.degrees(place[:, :2])
    rows = [
        [id, role, *("" if v != v else v for v in at), *3 * [SIGMA_CONTROL if k else ""]]
        for id, role, at, k in zip(points.id, points.role, place.tolist(), known)
    ]
    header = ("id", "role", "longitude", "latitude", "height", "sE", "sN", "sh")
    write_csv(folder / "points.csv", header, rows)
    rows = [
        ["ABC"[i], points.id[p], *xy]
        for i, p, xy in zip(observations.image, observations.point, observations.xy.tolist())
    ]
    write_csv(folder / "observations.csv", ("image", "point", "line", "pixel"), rows)
    west, north = place[known, 0].min() - 0.2, place[known, 1].max() + 0.2
    profile |= {"height": 60, "width": 60, "dtype": "float32", "crs": "EPSG:4326"}
    profile["transform"] = rasterio.Affine(0.01, 0.0, west, 0.0, -0.01, north)
    with rasterio.open(folder / "dem.tif", "w", **profile) as raster:
        raster.write(np.full((1, 60, 60), 400.0, "float32"))
    (folder / "refine.toml").write_text(TEXT)


def run(folder, *options):
    arguments = ["pushbroom", "refine", str(folder / "refine.toml"), *options]
    return CliRunner().invoke(app, arguments)


def change(folder, old, new):
    text = (folder / "refine.toml").read_text()
    assert old in text
    (folder / "refine.toml").write_text(text.replace(old, new))


@pytest.mark.further
def test_the_command_writes_compensated_coefficients(folder, scene):
    change(folder, "dem_sigma", 'rpc_format = "rpb"\ndem_sigma')
    done = run(folder, "--out", str(folder / "out"))
    assert done.exit_code == 0, done.output
    told = json.loads((folder / "out" / "result.json").read_text())
    assert told["counts"]["redundancy"] == told["redundancy"]
    assert len(told["terrain_heights"]) == 18 and told["counts"]["terrain heights"] == 18
    assert told["warnings"] == [] and 0.7 < told["sigma0"] < 1.3
    assert "3, 3 with RPC" in done.output and "terrain heights" in done.output
    assert "3 with RPC" in (folder / "out" / "report.html").read_text()
    # the coefficients put the adjusted points where their measurements are
    table = read_csv(folder / "out" / "points.csv")
    X = np.stack([table.numbers(name) for name in "XYZ"])
    ground = tuple(np.asarray(v) for v in geodetic(WGS84, tuple(X)))
    at = {id: k for k, id in enumerate(table.values["id"])}
    seen = read_csv(folder / "observations.csv")
    xy = np.stack([seen.numbers(name) for name in ("line", "pixel")], 1)
    for name in "ABC":
        line, sample, _ = project_points(read_rpc(folder / "out" / f"{name}.RPB"), *ground)
        rows = [(k, at[p]) for k, (i, p) in
                enumerate(zip(seen.values["image"], seen.values["point"])) if i == name]
        v = np.array([(line[p] - xy[k, 0], sample[p] - xy[k, 1]) for k, p in rows])
        by_point = {r["point"]: r["v"] for r in told["image_points"] if r["image"] == name}
        expected = [by_point[seen.values["point"][k]] for k, _ in rows]
        np.testing.assert_allclose(v, expected, atol=5e-3)
    # read again and adjusted again, the biases are nearly gone
    for name in "ABC":
        change(folder, {"A": "a.tif", "B": "b.RPB", "C": "c_RPC.TXT"}[name], f"out/{name}.RPB")
    again = json.loads(run(folder, "--json", "-").stdout)
    assert max(abs(row["change"]) for row in again["unknowns"]) < 1.0


@pytest.mark.parametrize("old,new,message", [
    ("bias_degree = 1", "bias_degree = 3", "bias_degree is 3; expected 0, 1 or 2"),
    ("bias = [6.0, 0.8]", "bias = [1, 2, 3]", "bias is .*; expected one σ, or two"),
    ("bias = [6.0, 0.8]", 'bias = "stated"', "b.RPB states no error|a.tif states no error"),
    ("bias = [6.0, 0.8]", 'bias = "vague"', "'vague'; expected \"free\", \"held\" or a prior"),
    ("[unknowns]", '[unknowns.A]\nattitude = "free"\n[unknowns]',
     r"\[unknowns.A\]: attitude is no unknown of an image with RPC, which has bias_degree, bias"),
    ("[unknowns]", '[models]\nA = "rigorous"\n[unknowns]', "A = \"rigorous\": .*a.tif has"),
    ("[unknowns]", '[models]\nA = "rcp"\n[unknowns]', "'rcp'.*rpc"),
    ("dem_sigma = 300.0", "", "dem_sigma is missing; expected the σ of a height of dem.tif"),
    ("dem_sigma = 300.0", "dem_sigma = 0.0", "dem_sigma is 0; expected metres above 0"),
    ('dem = "dem.tif"', "", "dem_sigma: needs a terrain model; give dem"),
    ("dem_sigma = 300.0", 'dem_sigma = 300.0\nrpc_format = "xml"', "rpc_format 'xml'"),
])  # fmt: skip
def test_wrong_settings_are_told(folder, old, new, message):
    change(folder, old, new)
    with pytest.raises(InputError, match=message):
        read_refinement(folder / "refine.toml")


def test_files_that_do_not_fit_are_named(folder, monkeypatch, capsys):
    """In one line each, with status 2."""

    def told(words, restore):
        arguments = ["jaxbundle", "pushbroom", "refine", str(folder / "refine.toml")]
        monkeypatch.setattr(sys, "argv", arguments)
        with pytest.raises(SystemExit) as ended:
            cli.main()
        out, err = capsys.readouterr()
        assert ended.value.code == 2 and out == "" and len(err.splitlines()) == 1, err
        assert all(word in err for word in words), err
        for path, content in restore.items():
            path.write_bytes(content)

    def damage(name, function):
        path = folder / name
        before = path.read_bytes()
        path.write_bytes(function(before))
        return {path: before}

    told(["c_RPC.TXT, line", "expected NAME: value"],
         damage("c_RPC.TXT", lambda b: b[: len(b) // 2]))
    told(["b.RPB", "coefficients"], damage("b.RPB", lambda b: b[: len(b) - 300]))
    exchanged = b"image,point,pixel,line"
    told(["line and pixel seem to be exchanged"],
         damage("observations.csv", lambda b: b.replace(b"image,point,line,pixel", exchanged)))
    told(["observations.csv", "line 2", "is off the image", "4000"],
         damage("observations.csv", lambda b: b.replace(b.splitlines()[1], b"A,P0,5000,2000")))
    profile = {"driver": "GTiff", "height": 9, "width": 9, "count": 1, "dtype": "float32",
               "crs": "EPSG:4326", "transform": rasterio.Affine(0.1, 0.0, 0.0, 0.0, -0.1, 0.0)}
    with rasterio.open(folder / "far.tif", "w", **profile) as raster:
        raster.write(np.zeros((1, 9, 9), "float32"))
    restore = damage("refine.toml", lambda b: b.replace(b"dem.tif", b"far.tif"))
    told(["far.tif", "give a model that covers the image"], restore)
    with open_plain(folder / "plain.tif", "w", driver="GTiff", height=9, width=9, count=1,
                       dtype="uint8"):
        pass
    restore = damage("refine.toml", lambda b: b.replace(b"a.tif", b"plain.tif"))
    told(["plain.tif", "no RPC tags"], restore)


def test_stated_errors_are_read(folder, scene):
    rpb, text = (folder / "b.RPB").read_text(), (folder / "c_RPC.TXT").read_text()
    assert read_stated_errors(folder / "b.RPB") == (0.0, 0.0)
    (folder / "b.RPB").write_text(rpb.replace("\tline", "\terrBias = 6.0;\n\tline", 1))
    assert read_stated_errors(folder / "b.RPB") == (6.0, 0.0)
    (folder / "c_RPC.TXT").write_text("ERR_BIAS: 3.5 meters\nERR_RAND: 0.25\n" + text)
    assert read_stated_errors(folder / "c_RPC.TXT") == (3.5, 0.25)
    (folder / "x.xml").write_text("<a><ERRBIAS>-1.0</ERRBIAS><ERRRAND>2.6e-01</ERRRAND></a>")
    assert read_stated_errors(folder / "x.xml") == StatedErrors(0.0, 0.26)
    # a shift of 6 m is one of 2 pixels of 3 m; without a statement the bias is free, and said so
    change(folder, "bias_degree = 1\nbias = [6.0, 0.8]", "")
    file = read_refinement(folder / "refine.toml")
    sigma = [one.bias_sigma for one in file.images]
    assert np.isinf(sigma[0]).all() and sigma[0].shape == (2, 1)
    np.testing.assert_allclose(sigma[1], [[2.0], [2.0]], rtol=0.02)
    assert len(file.warnings) == 1 and "a.tif states no error" in file.warnings[0]


def test_frames_of_images_must_be_one(folder, scene, tmp_path):
    from refinement_scenes import satellite

    from jaxbundle.io.scanner.writing import write_scanner_image

    image = satellite()
    with pytest.raises(InputError, match="S: attitudes against the orbit need an Earth"):
        write_scanner_image(tmp_path, "S", image, None)
    attitude = dataclasses.replace(image.trajectory.attitude, reference="earth")
    local = dataclasses.replace(image.trajectory, attitude=attitude)
    write_scanner_image(tmp_path, "S", dataclasses.replace(image, trajectory=local), None)
    change(folder, "[unknowns]", 'S = "S.toml"\n[unknowns]\nattitude = "free"')
    with pytest.raises(InputError, match="'A' and 'S' have different ellipsoids or frames"):
        read_refinement(folder / "refine.toml")
    write_scanner_image(tmp_path, "S", image, WGS84)
    file = read_refinement(folder / "refine.toml")
    assert file.images[3].freedom == dataclasses.replace(
        Freedom(), attitude=(np.inf,) * 3, position=HELD
    )


def test_tie_points_of_a_table_of_their_own_need_no_row_in_points(folder):
    """The same refinement as with all in one table."""
    whole = read_refinement(folder / "refine.toml")
    role = dict(zip(whole.points.id, whole.points.role))
    for name, ties in (("points.csv", False), ("observations.csv", False), ("ties.csv", True)):
        source = folder / ("observations.csv" if ties else name)
        head, *lines = (folder / "all.csv" if ties else source).read_text().splitlines()
        if name == "observations.csv":
            (folder / "all.csv").write_text("\n".join([head, *lines]))
        place = 0 if name == "points.csv" else 1
        kept = [line for line in lines if (role[line.split(",")[place]] == "tie") == ties]
        (folder / name).write_text("\n".join([head, *kept]) + "\n")
    change(folder, "[refine]", "[refine]\ntie_points = \"ties.csv\"")
    found = read_refinement(folder / "refine.toml")
    assert sorted(zip(found.points.id, found.points.role)) == sorted(role.items())
    rows = lambda file: sorted(
        (file.images[i].id, file.points.id[p], *xy)
        for i, p, xy in zip(file.observations.image, file.observations.point,
                            file.observations.xy.tolist())
    )  # fmt: skip
    assert rows(found) == rows(whole)
    (folder / "ties.csv").write_text("image,point,line\nA,P1,5\n")
    with pytest.raises(InputError, match="ties.csv: column 'pixel' is missing"):
        read_refinement(folder / "refine.toml")
