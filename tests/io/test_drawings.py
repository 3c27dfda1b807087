"""PLY, DXF and CSV of points and cameras, read back by other means."""

import csv
import dataclasses
import struct
import sys

import ezdxf
import numpy as np
import pytest
from exchange_cases import ANGLES, POINTS, POSITION, matrix, network
from numpy.testing import assert_allclose

from jaxbundle.errors import InputError
from jaxbundle.io import read_network
from jaxbundle.io.networks.colmap import write_colmap
from jaxbundle.io.networks.project import write_project
from jaxbundle.io.results.coordinates import images_path, write_coordinates
from jaxbundle.io.results.dxf import write_dxf
from jaxbundle.io.results.ply import write_ply
from jaxbundle.io.results.pyramids import pyramids
from jaxbundle.network.reprojection import point_errors
from jaxbundle.network.tables import Points


def case():
    """The network with a control point and a point without coordinates."""
    net = network("opencv", ("a", "b", "c"))
    position, sigma = net.points.position.copy(), net.points.sigma.copy()
    position[4], sigma[2] = np.nan, (0.1, 0.2, np.inf)
    role = ("tie", "tie", "control", *["tie"] * 9)
    return net.replace(points=Points(net.points.id, role, position, sigma), angle_unit="deg")


def test_pyramids_look_where_the_camera_looks():
    net = case()
    corners, edges = pyramids(net)
    assert corners.shape == (3, 5, 3) and edges.shape == (3, 8, 2)
    assert_allclose(corners[:, 0], POSITION)
    for M, pyramid in zip(map(matrix, ANGLES), corners):
        r, s, q = ((pyramid[1:] - pyramid[0]) @ M.T).T
        assert (q < 0).all()
        assert_allclose(abs(r / q), 640 / 1000)
        assert_allclose(abs(s / q), 360 / 1002)
    assert set(np.unique(edges)) == set(range(15))


def test_ply(tmp_path):
    path = tmp_path / "net.ply"
    assert "points (1)" in write_ply(case(), path)
    data = path.read_bytes()
    head, body = data.split(b"end_header\n", 1)
    lines = head.decode().splitlines()
    assert lines[:2] == ["ply", "format binary_little_endian 1.0"]
    assert "element vertex 26" in lines and "element edge 24" in lines
    vertex = np.frombuffer(body[: 26 * 31], "<f8,<f8,<f8,u1,u1,u1,<f4")
    assert_allclose(np.stack([vertex[f"f{k}"][:11] for k in range(3)], 1), np.delete(POINTS, 4, 0))
    assert vertex["f3"][2] != vertex["f3"][0]
    edges = np.frombuffer(body[26 * 31 :], "<i4").reshape(-1, 2)
    assert len(edges) == 24 and edges.min() == 11 and edges.max() == 25


def test_dxf(tmp_path):
    path = tmp_path / "net.dxf"
    write_dxf(case(), path)
    drawing = ezdxf.readfile(path)
    assert not drawing.audit().has_errors
    space = drawing.modelspace()
    tie = list(space.query('POINT[layer=="POINTS_TIE"]'))
    assert len(tie) == 10
    assert_allclose(tie[0].dxf.location, POINTS[0])
    assert len(space.query('POINT[layer=="POINTS_CONTROL"]')) == 1
    names = {t.dxf.text for t in space.query('TEXT[layer=="POINT_NAMES"]')}
    assert names == {str(k + 1) for k in range(12) if k != 4}
    assert len(space.query('LINE[layer=="CAMERAS"]')) == 24
    assert {t.dxf.text for t in space.query('TEXT[layer=="CAMERA_NAMES"]')} == {"a", "b", "c"}


def test_csv(tmp_path):
    path = tmp_path / "net.csv"
    write_coordinates(case(), path)
    rows = list(csv.DictReader(path.read_text().splitlines()))
    assert rows[4]["X"] == "" and rows[2]["sZ"] == "free" and rows[2]["role"] == "control"
    assert_allclose([float(rows[0][axis]) for axis in "XYZ"], POINTS[0], rtol=1e-15)
    images = list(csv.DictReader(images_path(path).read_text().splitlines()))
    assert [row["id"] for row in images] == ["a", "b", "c"]
    assert_allclose([float(images[1][k]) for k in ("omega", "phi", "kappa")],
                    np.degrees(ANGLES[1]), rtol=1e-13)  # fmt: skip


def test_a_camera_without_orientation_is_refused(tmp_path):
    net = case()
    images = type(net.images)(net.images.id, net.images.camera, net.images.position * np.nan,
                              net.images.angles, net.images.sigma)  # fmt: skip
    for write, name in ((write_ply, "x.ply"), (write_dxf, "x.dxf")):
        with pytest.raises(InputError, match="image 'a' has no orientation"):
            write(net.replace(images=images), tmp_path / name)
    assert not list(tmp_path.iterdir())


def test_dxf_says_what_to_install(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "ezdxf", None)
    with pytest.raises(InputError, match=r"DXF needs ezdxf: pip install 'jaxbundle\[files\]'"):
        write_dxf(case(), tmp_path / "net.dxf")
    assert not list(tmp_path.iterdir())


def disturbed(model):
    """One image point of point 2 displaced by 5 px, which is seen in three images, and one of point
    4 by 1 px, seen in two; the others are exact."""
    net = network(model)
    camera, rays = net.cameras[0], net.observations
    step = np.array(camera.pixel_size) if model == "brown" else np.ones(2)
    xy = rays.xy.copy()
    for point, by in ((1, (3, -4)), (3, (1, 0))):
        xy[np.flatnonzero(rays.point == point)[0]] += np.array(by) * step
    return net.replace(observations=dataclasses.replace(rays, xy=xy))


WANTED = np.array([0, 5 / 3, 0, 1 / 2, *[0] * 8])


@pytest.mark.parametrize("model", ["opencv", "brown"])
def test_points_carry_their_reprojection_error(tmp_path, model):
    net = disturbed(model)
    errors, unit = point_errors(net)
    assert unit == "px"
    assert_allclose(errors, WANTED, atol=1e-9)
    write_coordinates(net, tmp_path / "net.csv")
    with (tmp_path / "net.csv").open() as file:
        assert_allclose([float(row["error_px"]) for row in csv.DictReader(file)], errors)
    write_ply(net, tmp_path / "net.ply")
    head, body = (tmp_path / "net.ply").read_bytes().split(b"end_header\n", 1)
    vertex = np.frombuffer(body[: 27 * 31], "<f8,<f8,<f8,u1,u1,u1,<f4")
    assert b"in px" in head and np.isnan(vertex["f6"][12:]).all()
    assert_allclose(vertex["f6"][:12], WANTED, atol=1e-6)


def test_reprojection_errors_in_colmap(tmp_path):
    net = disturbed("opencv")
    write_colmap(net, tmp_path / "text", text=True)
    lines = (tmp_path / "text" / "points3D.txt").read_text().splitlines()[1:]
    assert_allclose([float(line.split()[7]) for line in lines], WANTED, atol=1e-9)
    write_colmap(net, tmp_path / "binary")
    data = (tmp_path / "binary" / "points3D.bin").read_bytes()[8:]
    for wanted in WANTED:
        (error, rays), data = struct.unpack("<dQ", data[35:51]), data[51:]
        assert error == pytest.approx(wanted, abs=1e-9)
        data = data[8 * rays :]
    assert not data


def test_reprojection_errors_where_there_is_nothing():
    """A point without coordinates, one without image points, cameras without a pixel size."""
    net = case()
    rays = net.observations
    net = net.replace(observations=rays.take(rays.point != 7))
    assert np.isnan(point_errors(net)[0][[4, 7]]).all()
    brown = network("brown")
    camera = dataclasses.replace(brown.cameras[0], pixel_size=None)
    assert point_errors(brown.replace(cameras=(camera,)))[1] == "mm"


def test_a_table_of_points_with_errors_is_read(tmp_path):
    net = network()
    write_project(net, tmp_path)
    write_coordinates(net, tmp_path / "points.csv")
    assert_allclose(read_network(tmp_path).points.position, POINTS)
