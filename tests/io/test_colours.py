"""Colours of points: read, kept from format to format, told where they are lost."""

import csv
import json
import struct

import numpy as np
import plyfile
import pytest
from conversions import full_network, write
from exchange_cases import network
from foreign_samples import NVM, write_sample

import jaxbundle
from jaxbundle.errors import InputError
from jaxbundle.io import convert, read_network, write_project
from jaxbundle.io.networks.bundler import write_bundler
from jaxbundle.io.networks.control import with_control
from jaxbundle.io.results.coordinates import write_coordinates
from jaxbundle.io.results.ply import COLOURS, write_ply
from jaxbundle.network.build import make_network
from jaxbundle.network.tables import GREY, Points

RGB = np.random.default_rng(3).integers(0, 256, (12, 3)).astype(np.uint8)


def coloured(model="opencv", *more):
    net = network(model, *more)
    return net.replace(points=net.points.with_colours(dict(zip(net.points.id, RGB.tolist()))))


def of_colmap(path) -> dict[int, tuple[int, ...]]:
    """The colours of points3D.bin by COLMAP's documentation alone."""
    data = path.read_bytes()
    (number,), position, found = struct.unpack_from("<Q", data), 8, {}
    for _ in range(number):
        id, _, _, _, *rgb, _, rays = struct.unpack_from("<Q3d3BdQ", data, position)
        position += struct.calcsize("<Q3d3BdQ") + 8 * rays
        found[id] = tuple(rgb)
    return found


@pytest.mark.parametrize("kind", ["colmap", "colmap-text", "opensfm", "project"])
def test_from_colmap_through_every_format_and_back(tmp_path, kind):
    given = write("colmap", coloured(), tmp_path)[0]
    expected = {k + 1: tuple(rgb) for k, rgb in enumerate(RGB.tolist())}
    assert of_colmap(given / "points3D.bin") == expected
    middle = tmp_path / "middle"
    assert not any("colour" in what for what in convert(given, middle, to=kind).lost)
    convert(middle, tmp_path / "again_sparse")
    assert of_colmap(tmp_path / "again_sparse" / "points3D.bin") == expected


def test_colmap_itself_sees_them(tmp_path):
    import pycolmap
    for kind in ("colmap", "colmap-text"):
        model = pycolmap.Reconstruction(write(kind, coloured(), tmp_path)[0])
        found = {id: point.color.tolist() for id, point in model.points3D.items()}
        assert found == {k + 1: rgb for k, rgb in enumerate(RGB.tolist())}


def test_bundler(tmp_path):
    path = tmp_path / "bundle.out"
    write_bundler(coloured("snavely", ("0", "1", "2"), 0), path)
    lines = path.read_text().splitlines()
    assert [list(map(int, line.split())) for line in lines[18::3]] == RGB.tolist()
    np.testing.assert_array_equal(read_network(path).points.colour, RGB)


def test_visualsfm_and_alicevision(tmp_path):
    path = tmp_path / "model.nvm"
    path.write_text(NVM)
    assert read_network(path).points.colour.tolist() == [[10, 20, 30]]
    scene = write_sample(tmp_path, "alicevision")
    assert read_network(scene).points.colour.tolist() == [[1, 2, 3]]


def test_opensfm_colours_may_be_missing_and_are_rounded(tmp_path):
    folder = write("opensfm", coloured(), tmp_path)[0]
    file = folder / "reconstruction.json"
    (scene,) = json.loads(file.read_text())
    ids = list(scene["points"])
    del scene["points"][ids[0]]["color"]
    scene["points"][ids[1]]["color"] = [12.6, -3, 300]
    file.write_text(json.dumps([scene]))
    found = read_network(folder).points.colour
    assert found[:2].tolist() == [list(GREY), [13, 0, 255]]
    np.testing.assert_array_equal(found[2:], RGB[2:])
    scene["points"][ids[1]]["color"] = [1, 2]
    file.write_text(json.dumps([scene]))
    with pytest.raises(InputError, match=f"{ids[1]}.*color"):
        read_network(folder)


@pytest.mark.parametrize("none", [(0, 0, 0), GREY])
def test_what_programs_without_colours_write_is_none(tmp_path, none):
    net = coloured()
    net = net.replace(points=net.points.with_colours(dict.fromkeys(net.points.id, none)))
    assert read_network(write("colmap", net, tmp_path)[0]).points.colour is None


def test_a_project(tmp_path):
    write_project(coloured(), tmp_path / "p")
    with (tmp_path / "p" / "points.csv").open(newline="") as file:
        rows = [*csv.DictReader(file)]
    assert [[int(row[c]) for c in ("red", "green", "blue")] for row in rows] == RGB.tolist()
    write_project(network(), tmp_path / "q")
    assert "red" not in (tmp_path / "q" / "points.csv").read_text()


@pytest.mark.parametrize("colours, message", [
    (dict(red=[1] * 12, green=[2] * 12, blue=[256] * 12), "row 1: blue is 256.*from 0 to 255"),
    (dict(red=[1.5] * 12, green=[2] * 12, blue=[3] * 12), "row 1: red is 1.5"),
    (dict(red=[1] * 12, green=[2] * 12, blue=[None] + [3] * 11), "row 1: blue is nan"),
    (dict(red=[1] * 12), "column 'green' is missing"),
])  # fmt: skip
def test_wrong_colours_of_tables_are_refused(colours, message):
    net = network()
    points = {"id": net.points.id, **dict(zip("XYZ", net.points.position.T)), **colours}
    rays = net.observations
    observations = {
        "image": [net.images.id[i] for i in rays.image],
        "point": [net.points.id[p] for p in rays.point],
        **dict(zip("xy", rays.xy.T)),
    }
    images = {"id": net.images.id, "camera": [net.cameras[0].id] * 3}
    with pytest.raises(InputError, match=message):
        make_network(net.cameras, images, points, observations, image_unit="px")


def test_empty_cells_are_grey():
    net = network()
    points = {"id": net.points.id, "red": [1] + [None] * 11, "green": [2] + [None] * 11,
              "blue": [3] + [None] * 11}  # fmt: skip
    rays = net.observations
    observations = {
        "image": [net.images.id[i] for i in rays.image],
        "point": [net.points.id[p] for p in rays.point],
        **dict(zip("xy", rays.xy.T)),
    }
    images = {"id": net.images.id, "camera": [net.cameras[0].id] * 3}
    made = make_network(net.cameras, images, points, observations, image_unit="px")
    assert made.points.colour.tolist() == [[1, 2, 3]] + [list(GREY)] * 11


def test_drawings_and_tables_have_them(tmp_path):
    vertex = lambda path: plyfile.PlyData.read(str(path))["vertex"]
    rgb = lambda v: np.stack([v[c][:12] for c in ("red", "green", "blue")], 1)
    write_ply(coloured(), tmp_path / "a.ply")
    np.testing.assert_array_equal(rgb(vertex(tmp_path / "a.ply")), RGB)
    # without colours by role; given ones come first
    write_ply(network(), tmp_path / "b.ply", {"1": (7, 8, 9)})
    found = rgb(vertex(tmp_path / "b.ply")).tolist()
    assert found == [[7, 8, 9]] + [list(COLOURS["tie"])] * 11
    write_coordinates(coloured(), tmp_path / "a.csv")
    with (tmp_path / "a.csv").open(newline="") as file:
        rows = [*csv.DictReader(file)]
    assert [[int(row[c]) for c in ("red", "green", "blue")] for row in rows] == RGB.tolist()


@pytest.mark.parametrize("output", ["n.dxf", "sfm_data.json"])
def test_a_loss_is_told(tmp_path, output):
    given = write("colmap", coloured("kannala-brandt"), tmp_path)[0]
    assert "colours of points (12)" in convert(given, tmp_path / output).lost


def test_they_go_with_their_points():
    net = full_network("opencv")
    rows = np.array([3, 0, 5])
    assert net.points.take(rows).colour.tolist() == net.points.colour[rows].tolist()
    control = Points(("P5", "P6", "P8"), ("control",) * 3, net.points.position[[5, 6, 8]],
                     np.full((3, 3), 0.1))  # fmt: skip
    np.testing.assert_array_equal(with_control(net, control).points.colour, net.points.colour)


def test_an_adjustment_keeps_them(tmp_path):
    net = coloured()
    result = jaxbundle.adjust(net)
    result.save(tmp_path / "saved.npz")
    for network_ in (
        result.network,
        jaxbundle.io.adjusted_network(result),
        jaxbundle.io.readjustable_network(result),
        jaxbundle.load_adjustment(tmp_path / "saved.npz").network,
    ):
        np.testing.assert_array_equal(network_.points.colour, RGB)
    # A result may have been renamed, as parts of a reconstruction are.
    renamed = result.with_changes()
    renamed.network = result.network.replace(name="part 1")
    for network_of in (jaxbundle.io.adjusted_network, jaxbundle.io.readjustable_network):
        assert network_of(renamed).name == "part 1"


@pytest.mark.parametrize("kind", ["colmap", "colmap-text", "opensfm", "project", "bundler"])
def test_points_without_image_points_are_kept(tmp_path, command, kind):
    """Models of networks that predict depth, and reconstructions without their tracks."""
    net = coloured("snavely" if kind == "bundler" else "opencv")
    net = net.replace(observations=net.observations.take(np.zeros(0, int)))
    path = write(kind, net, tmp_path)[0]
    back = read_network(path)
    np.testing.assert_array_equal(back.points.position, net.points.position)
    np.testing.assert_array_equal(back.points.colour, RGB)
    assert len(back.images) == 3 and not len(back.observations)
    write_ply(back, tmp_path / "p.ply")
    assert plyfile.PlyData.read(str(tmp_path / "p.ply"))["vertex"].count == 12 + 5 * 3
    told = command("adjust", path)
    assert told.status == 2 and "there are no image points" in told.err


def test_opensfm_without_its_tracks(tmp_path):
    folder = write("opensfm", coloured(), tmp_path)[0]
    (folder / "tracks.csv").unlink()
    net = read_network(folder)
    assert len(net.points) == 12 and any("tracks.csv is not there" in w for w in net.warnings)
