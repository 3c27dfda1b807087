"""`convert`: formats recognised, accuracy and losses of conversions, refusals."""

import dataclasses
import os
import sys

import numpy as np
import pytest
from exchange_cases import CAMERAS, assert_same, network

from jaxbundle import cli
from jaxbundle.errors import InputError
from jaxbundle.io import convert, read_cameras, read_network, write_cameras, write_project


@pytest.fixture
def opencv(tmp_path):
    return write_project(network("opencv", ("a", "b", "c")), tmp_path / "opencv").parent


@pytest.fixture
def brown(tmp_path):
    return write_project(network("brown", ("a", "b", "c")), tmp_path / "brown").parent


@pytest.mark.parametrize(
    "name, to, kind",
    [
        ("model_colmap", None, "colmap"), ("sparse/0", None, "colmap"),
        ("texts", "colmap-text", "colmap-text"), ("copy", None, "project"),
        ("copy/project.toml", None, "project"), ("n.ply", None, "ply"), ("n.dxf", None, "dxf"),
        ("n.csv", None, "csv"), ("cam.yaml", None, "opencv"), ("cam.json", None, "opencv"),
        ("cam.toml", None, "cameras"),
    ],
)  # fmt: skip
def test_kinds_of_output(opencv, tmp_path, name, to, kind):
    (tmp_path / "sparse").mkdir()
    done = convert(opencv, tmp_path / name, to=to)
    assert done.kind == kind and not done.conversions and (tmp_path / name).exists()
    if kind in ("colmap", "colmap-text", "project"):
        assert_same(network("opencv", ("a", "b", "c")), read_network(tmp_path / name))
    if kind in ("opencv", "cameras"):
        (camera,) = read_cameras(tmp_path / name)
        given = CAMERAS["opencv"].parameters
        assert {k: v for k, v in camera.parameters.items() if v} == given
    assert not [p for p in tmp_path.rglob("*.tmp")]


def test_what_is_outside_the_image_is_told(opencv, tmp_path):
    toml = opencv / "project.toml"
    toml.write_text(toml.read_text().replace("1280, 720", "400, 300"))
    told = convert(opencv, tmp_path / "copy").warnings
    assert ["principal point" in line for line in told] == [True, False]
    assert "camera '1': the principal point (641, 358.5) px is outside the image of 400" in told[0]
    write_cameras(read_network(opencv).cameras, tmp_path / "one.toml")
    assert convert(tmp_path / "one.toml", tmp_path / "c.yaml").warnings == told[:1]


@pytest.mark.parametrize("name", ["p.txt", "p.bal", "p.gz", "p.out"])
def test_a_principal_point_is_no_hindrance(tmp_path, name):
    """OpenCV with fx = fy, k1, k2 is Bundler's camera, counted from its principal point."""
    parameters = dict(fx=900.0, fy=900.0, cx=650.0, cy=350.0, k1=-0.1)
    camera = type(CAMERAS["opencv"])("1", "opencv", parameters)
    folder = write_project(network("opencv").replace(cameras=(camera,)), tmp_path / "n").parent
    done = convert(folder, tmp_path / name)
    assert done.conversions["1"].exact and "that images share a camera (2)" in done.lost
    back = read_network(tmp_path / name)
    assert back.cameras[0].parameters == dict(f=900, k1=-0.1, k2=0)
    xy = network("opencv").observations.xy
    order = np.lexsort((back.observations.point, back.observations.image))
    np.testing.assert_allclose(
        back.observations.xy[order], (xy - [650, 350]) * [1, -1], atol=1e-10
    )


def test_bundlers_cameras_need_an_image_size_to_become_colmaps(tmp_path):
    from jaxbundle.io import write_bal

    net = network("snavely", ("0", "1", "2"), 0)
    write_bal(net, tmp_path / "p.txt")
    with pytest.raises(InputError, match="image_size is needed.*give --image-size"):
        convert(tmp_path / "p.txt", tmp_path / "colmap")
    done = convert(tmp_path / "p.txt", tmp_path / "colmap", image_size=(1001, 801))
    assert all(cost.exact for cost in done.conversions.values())
    back = read_network(tmp_path / "colmap")
    xy = net.observations.xy * [1, -1] + [500, 400]
    np.testing.assert_allclose(back.observations.xy, xy, atol=1e-9)
    convert(tmp_path / "colmap", tmp_path / "q.txt")
    again = read_network(tmp_path / "q.txt")
    np.testing.assert_allclose(again.observations.xy, net.observations.xy, atol=1e-9)
    many = dataclasses.replace(done, conversions={str(k): cost for k in range(12)
                                                  for cost in [done.conversions["0"]]})
    assert len(str(many).splitlines()) == 11 and "and 4 more cameras" in str(many)
    assert again.cameras[2].parameters == pytest.approx(net.cameras[0].parameters)
    with pytest.raises(InputError, match="image_size"):
        convert(tmp_path / "p.txt", tmp_path / "colmap", image_size=(-1, 5))


def test_a_conversion_that_is_not_exact_must_be_asked_for(brown, tmp_path):
    out = tmp_path / "colmap"
    with pytest.raises(InputError, match="no model 'brown'.*largest.*px; give --model opencv"):
        convert(brown, out)
    assert not out.exists()
    done = convert(brown, out, model="opencv")
    cost = done.conversions["1"]
    assert not cost.exact and 1e-6 < cost.largest < 1
    assert f"largest difference {cost.largest:.3g} px" in str(done)
    measured = convert(brown, out, model="opencv", measured=True, force=True).conversions["1"]
    assert measured.largest < cost.largest
    back = tmp_path / "back"
    with pytest.raises(InputError, match="pixel_size is needed.*give --pixel-size WIDTH,HEIGHT"):
        convert(out, back, model="brown")
    again = convert(out, back, model="brown", pixel_size=(0.005, 0.005))
    before, after = network("brown", ("a", "b", "c")), read_network(back)
    limit = 0.005 * measured.largest + again.conversions["1"].largest
    for name, value in before.cameras[0].parameters.items():
        # the parameters are correlated: what counts is their effect, bounded at r = 3.7 mm
        power = {"K1": 3, "K2": 5, "P1": 2, "P2": 2}.get(name, 0)
        difference = abs(after.cameras[0].parameters[name] - value) * 3.7**power
        assert difference < 100 * limit
    key = lambda n: np.lexsort((n.observations.point, n.observations.image))
    np.testing.assert_allclose(
        after.observations.xy[key(after)], before.observations.xy[key(before)], atol=1e-9
    )


def test_camera_files(brown, tmp_path):
    convert(brown, tmp_path / "b.toml")
    done = convert(tmp_path / "b.toml", tmp_path / "o.yaml", model="opencv")
    assert "fitted over the image" in str(done)
    back = convert(tmp_path / "o.yaml", tmp_path / "c.toml")
    assert back.kind == "cameras" and read_cameras(tmp_path / "c.toml")[0].model == "opencv"
    both = [CAMERAS["opencv"], type(CAMERAS["brown"])("2", "brown", {"c": 5.0})]
    write_cameras(both, tmp_path / "two.toml")
    assert read_cameras(tmp_path / "two.toml")[1].parameters == {"c": 5.0}
    with pytest.raises(InputError, match="2 cameras .*name one of them"):
        convert(tmp_path / "two.toml", tmp_path / "x.yaml")
    convert(tmp_path / "two.toml", tmp_path / "x.yaml", camera="1")
    made = convert(tmp_path / "two.toml", tmp_path / "cameras.txt", camera="1")
    assert made.kind == "colmap-cameras"
    (camera,) = read_cameras(tmp_path / "cameras.txt")
    given = CAMERAS["opencv"]
    assert camera.parameters == pytest.approx(given.parameters, rel=1e-15)
    assert camera.image_size == given.image_size
    with pytest.raises(InputError, match="contains only cameras"):
        convert(tmp_path / "two.toml", tmp_path / "x.ply")
    with pytest.raises(InputError, match="no camera '7'"):
        convert(tmp_path / "two.toml", tmp_path / "y.yaml", camera="7")


REFUSED = {
    "kind": (dict(output="x.foo"), "not recognised; give --to"),
    "to": (dict(output="x", to="photo-list"), "--to photo-list: cannot be written"),
    "close": (dict(output="x", to="colmab"), "did you mean 'colmap'"),
    "model": (dict(output="x.out", model="brown"), "bundler has snavely only"),
    "unknown model": (dict(output="x", model="opencx"), "unknown camera model 'opencx'"),
    "camera": (dict(output="x.ply", camera="1"), "ply holds all cameras"),
    "folder": (dict(output="there", to="ply"), "there: is a folder"),
    "file": (dict(output="file", to="colmap"), "file: is a file"),
    "no folder": (dict(output="no/where.ply"), "there is no folder"),
    "itself": (dict(output="brown"), "is the input and would be overwritten"),
    "inside": (dict(output="brown", to="colmap"), "is the input and would be overwritten"),
    "table": (dict(output="brown/points.csv"), "is the input and would be overwritten"),
    "size": (dict(output="x.yaml", overrides=["camera.1.model=snavely"]), "unknown|no parameter"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_refused_and_nothing_written(brown, tmp_path, name):
    arguments, message = REFUSED[name]
    (tmp_path / "there").mkdir()
    (tmp_path / "file").write_text("")
    before = {p: p.stat().st_mtime_ns for p in tmp_path.rglob("*")}
    with pytest.raises(InputError, match=message):
        convert(brown, **{**arguments, "output": tmp_path / arguments["output"]})
    assert {p: p.stat().st_mtime_ns for p in tmp_path.rglob("*")} == before


@pytest.mark.parametrize(
    ("option", "value"),
    [("camera", "cam"), ("overrides", ["a=1"]), ("control", "c.csv"), ("measured", True)],
)
def test_what_a_file_of_cameras_cannot_have_is_refused(tmp_path, option, value):
    given = tmp_path / "cam.toml"
    given.write_text('[[camera]]\nid = "cam"\nmodel = "opencv"\nfx = 800.0\nfy = 800.0\n')
    with pytest.raises(InputError, match="omit it"):
        convert(given, tmp_path / "transforms.json", **{option: value})
    assert not (tmp_path / "transforms.json").exists()


def test_on_the_command_line(brown, tmp_path, monkeypatch, capsys):
    arguments = ["convert", brown, tmp_path / "sparse", "--model", "opencv", "--measured"]
    monkeypatch.setattr(sys, "argv", ["jaxbundle", *map(os.fspath, arguments)])
    with pytest.raises(SystemExit) as ended:
        cli.main()
    assert not ended.value.code
    out = capsys.readouterr().out
    assert "sparse: colmap\n" in out and "camera '1' → opencv: fitted" in out


BESIDE = {
    "o.yaml": ("opencv", "o.yaml"),
    "p.csv": ("opencv", "p_images.csv"),
    "bundle.out": ("snavely", "list.txt"),
    "folder": ("opencv", "folder/points.csv"),
    "colmap": ("opencv", "colmap/frames.txt"),
}


@pytest.mark.parametrize("name", BESIDE)
def test_what_is_there_is_replaced_only_by_force(tmp_path, name):
    model, other = BESIDE[name]
    write_project(network(model, ("a", "b", "c")), tmp_path / "given")
    there = tmp_path / other
    there.parent.mkdir(exist_ok=True)
    there.write_text("of somebody else")
    with pytest.raises(InputError, match=rf"{other}: already there.*--force"):
        convert(tmp_path / "given", tmp_path / name)
    assert there.read_text() == "of somebody else"
    assert [p.name for p in there.parent.iterdir() if p != tmp_path / "given"] == [there.name]
    convert(tmp_path / "given", tmp_path / name, force=True)
    assert not there.exists() or there.read_text() != "of somebody else"
