"""Files of Ames Stereo Pipeline in a refinement: `.match` of pairs, `.gcp`."""

import json
import struct

import numpy as np
import pytest
from rpc_block import SIGMA_CONTROL, block
from typer.testing import CliRunner

from jaxbundle.cli.app import app
from jaxbundle.cli.pushbroom import refine as _refine  # noqa: F401
from jaxbundle.errors import InputError
from jaxbundle.geometry.ellipsoid import WGS84, geodetic
from jaxbundle.io.scanner.asp_points import join_matches, read_gcp, read_match
from jaxbundle.io.scanner.refinement import read_refinement
from jaxbundle.io.scanner.rpc import write_rpc
from jaxbundle.refinement import refine

NAMES = ("left", "middle", "right")
TEXT = """
[refine]
observations = ["run-left__middle.match", "run-middle__right-clean.match", "control.gcp"]
sigma = 0.4

[images]
A = "left_RPC.TXT"
B = "middle_RPC.TXT"
right = "r.RPB"

[unknowns]
bias_degree = 1
bias = [6.0, 0.8]
"""


def match_file(first, second):
    """The bytes of a match file by its documentation; descriptors of three numbers and of none."""
    records = b""
    for k, (line, pixel) in enumerate([*first, *second]):
        length = 3 if k % 2 else 0
        numbers = pixel, line, round(pixel), round(line), 0.5, 1.0, 2.0, True, 1, 2, length
        records += struct.pack("<ffiifff?IIQ", *numbers)
        records += struct.pack(f"<{length}f", *range(length))
    return struct.pack("<QQ", len(first), len(second)) + records


@pytest.fixture
def folder(tmp_path):
    scene = block(rpc=3, scanner=0, points=30, control=6, checks=0, degree=1, rays=3)
    (_, points, observations), _ = scene.draw(np.random.default_rng(2))
    for one, name in zip(scene.images, ("left_RPC.TXT", "middle_RPC.TXT", "r.RPB")):
        write_rpc(tmp_path / name, one.image.rpc)
    # match files have single precision
    xy = observations.xy.astype("float32").astype(float)
    place = {(i, p): xy[k] for k, (i, p) in
             enumerate(zip(observations.image.tolist(), observations.point.tolist()))}
    ties = [p for p, role in enumerate(points.role) if role == "tie"]
    for i, j, name in ((0, 1, "run-left__middle.match"), (1, 2, "run-middle__right-clean.match")):
        both = [p for p in ties if (i, p) in place and (j, p) in place]
        ends = ([place[k, p] for p in both] for k in (i, j))
        (tmp_path / name).write_bytes(match_file(*ends))
    lines = ["# id latitude longitude height, σ, images"]
    for p in range(6):
        east, north, h = (float(v) for v in geodetic(WGS84, tuple(points.X[p])))
        fields = [f"{p},", float(np.degrees(north)), float(np.degrees(east)), h]
        fields += 3 * [SIGMA_CONTROL]
        for (i, q), x in place.items():
            if q == p:
                fields += [f"/data/{NAMES[i]}.tif", float(x[1]), float(x[0]), 0.4, 0.4]
        lines.append(" ".join(map(str, fields)))
    (tmp_path / "control.gcp").write_text("\n".join(lines) + " other.tif 1 2 1 1\n")
    (tmp_path / "refine.toml").write_text(TEXT)
    return tmp_path, scene, place


@pytest.mark.further
def test_matches_and_control_become_a_refinement(folder):
    path, scene, place = folder
    file = read_refinement(path / "refine.toml")
    points, seen = file.points, file.observations
    assert points.role.count("control") == 6 and set(points.role) == {"control", "tie"}
    np.testing.assert_allclose(points.X[:6], scene.X[:6], atol=5)
    assert file.warnings == (
        f"{path / 'control.gcp'}: measurements in images that are not in [images], or whose name "
        "several of them have: other.tif",
    )
    # a place of the middle image that is in both files makes one point with three rays
    rays = np.bincount(seen.point)
    ties = [p for p, role in enumerate(scene.roles) if role == "tie"]
    three = sum((0, p) in place and (1, p) in place and (2, p) in place for p in ties)
    assert three == (rays[6:] == 3).sum() > 10
    given = {tuple(x) for x in place.values()}
    assert {tuple(x) for x in seen.xy} <= given
    result = refine(*file[:4])
    assert 0.7 < result.sigma0 < 1.3 and result.redundancy > 30
    assert seen.source(0) == f"observations, line 2 of {path / 'control.gcp'}"
    arguments = ["pushbroom", "refine", str(path / "refine.toml"), "--json", "-"]
    done = CliRunner().invoke(app, arguments)
    told = json.loads(done.stdout)
    assert told["sigma0"] == pytest.approx(result.sigma0, rel=1e-9)


def test_pairs_are_joined_where_a_place_is_the_same():
    at = lambda *rows: np.array(rows, float)
    pairs = [
        (0, 1, at([1, 1], [2, 2], [3, 3]), at([11, 1], [12, 2], [13, 3])),
        (1, 2, at([11, 1], [12, 2]), at([21, 1], [22, 2])),
        # the second point would be twice in the first image
        (0, 2, at([1, 1], [9, 9]), at([21, 1], [22, 2])),
    ]
    found = join_matches(pairs)
    assert found.contradicting == 1
    rows = {tuple(r) for r in np.c_[found.image, found.xy].tolist()}
    assert rows == {(0, 1, 1), (1, 11, 1), (2, 21, 1), (0, 3, 3), (1, 13, 3)}
    assert sorted(np.bincount(found.point)) == [2, 3]


@pytest.mark.parametrize("name,damage,words", [
    ("run-left__middle.match", lambda b: b[:-5], "is cut"),
    ("run-left__middle.match", lambda b: b[:7], "is cut"),
    ("run-left__middle.match", lambda b: b + b"x", "is cut"),
    ("run-left__middle.match", lambda b: b"\xff" * 16 + b[16:], "is cut"),
    ("control.gcp", lambda b: b.replace(b" 0.4 0.4", b" 0.4", 1), "line 2: .* fields; expected id"),
    ("control.gcp", lambda b: b.replace(b"0.5 0.5 0.5", b"0.5 x 0.5", 1), "line 2.*x"),
    ("control.gcp", lambda b: b.replace(b"0.5 0.5 0.5", b"0.5 0.0 0.5", 1), "line 2: σ must be"),
    ("control.gcp", lambda b: b"", "no control point"),
    ("refine.toml", lambda b: b.replace(b"left_RPC", b"middle_RPC").replace(b"A =", b"Z ="),
     "the name of a match file"),
    ("refine.toml", lambda b: b.replace(b"control.gcp", b"none.gcp"), "no such file"),
])  # fmt: skip
def test_damaged_files_are_named(folder, name, damage, words):
    file = folder[0] / name
    file.write_bytes(damage(file.read_bytes()))
    with pytest.raises(InputError, match=words):
        read_refinement(folder[0] / "refine.toml")


def test_columns_become_pixels_and_latitude_comes_first(tmp_path):
    (tmp_path / "a.gcp").write_text(
        "5 23.7 160.1 427.1 1.0 2.0 3.0 image1.tif 124.5 19.7 1.0 0.5 image2.tif 254.3 73.9 1 1\n"
    )
    found = read_gcp(tmp_path / "a.gcp")
    assert found.geographic.tolist() == [[160.1, 23.7, 427.1]] and found.image[1] == "image2.tif"
    assert found.xy[0].tolist() == [19.7, 124.5] and found.xy_sigma[0].tolist() == [0.5, 1.0]
    (tmp_path / "a__b.match").write_bytes(match_file([(19.5, 124.5)], [(73.25, 254.0)]))
    first, second = read_match(tmp_path / "a__b.match")
    assert first.tolist() == [[19.5, 124.5]] and second.tolist() == [[73.25, 254.0]]
