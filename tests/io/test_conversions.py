"""What writers lose is told, with numbers, before anything is written, and is what is lost; what
they keep comes back to rounding."""

import csv
import dataclasses
import struct

import conversions
import cv2
import ezdxf
import numpy as np
import plyfile
import pytest
import yaml
from conversions import DRAWINGS, HOLDS, PAGE, full_network, holds, model_for, round_trip, write
from test_hostile_files import KINDS, made, read

from jaxbundle.io.formats import FORMATS
from jaxbundle.io.networks.losses import QUANTITIES, describe_losses
from jaxbundle.io.output_formats import CAMERA_KINDS, TARGETS
from jaxbundle.network.tables import Network

READ = [kind for kind in TARGETS if kind not in DRAWINGS]


def names(said) -> set[str]:
    """The quantities of the messages about losses."""
    return {what.rpartition(" (")[0] for what in said} & QUANTITIES.keys()


@pytest.mark.parametrize("kind", READ)
def test_what_is_lost_is_what_is_said(kind):
    found, said = round_trip(kind, full_network(model_for(kind)))
    assert names(said) == found.lost()
    rounding = {"camera parameter, relative": 1e-15, "image point": 1e-12}
    for what, value in found.greatest().items():
        assert value <= rounding.get(what, 1e-14), (what, value)


@pytest.mark.parametrize("kind", READ)
def test_of_a_plain_network_only_its_parts_and_names_are_lost(kind):
    found, said = round_trip(kind, full_network(model_for(kind), True))
    assert names(said) == found.lost()
    assert names(said) <= {"names of cameras", "names of images", "names of points", "points"}


def test_numbers_of_what_is_lost():
    said = describe_losses(full_network("brown"), dict(QUANTITIES))
    assert {"names of points (12)", "roles of points (4)", "σ of control points (2)",
            "prior σ of orientations (4)", "σ of image points (48)", "distances (1)", "rigs (4)",
            "that images share a camera (2)", "datum points (3)"} <= {*said}  # fmt: skip


def test_ply_by_an_independent_reader(tmp_path):
    net = full_network("brown")
    path, said = write("ply", net, tmp_path)
    head, _, body = path.read_bytes().partition(b"end_header\n")
    number = int(head.split(b"element vertex ")[1].split()[0])
    rows = [struct.unpack_from("<3d3Bf", body, 31 * k) for k in range(number)]
    assert number == 12 + 5 * 4
    assert [list(row[:3]) for row in rows[:12]] == net.points.position.tolist()
    assert np.isnan([row[6] for row in rows[12:]]).all()
    edges = int(head.split(b"element edge ")[1].split()[0])
    assert len(body) == 31 * number + 8 * edges
    assert {"names of points", "names of images", "image points"} <= names(said)


def test_ply_by_plyfile(tmp_path):
    net = full_network("brown")
    path, _ = write("ply", net, tmp_path)
    vertex = plyfile.PlyData.read(str(path))["vertex"]
    found = np.stack([vertex[axis][:12] for axis in "xyz"], 1)
    np.testing.assert_array_equal(found, net.points.position)


def test_dxf_by_ezdxf(tmp_path):
    net = full_network("brown")
    path, said = write("dxf", net, tmp_path)
    space = ezdxf.readfile(path).modelspace()
    points = [(p.dxf.layer, *p.dxf.location) for p in space.query("POINT")]
    expected = zip((f"POINTS_{role.upper()}" for role in net.points.role), net.points.position)
    assert sorted(points) == sorted((layer, *X.tolist()) for layer, X in expected)
    texts = {t.dxf.text: tuple(t.dxf.insert) for t in space.query("TEXT")}
    named = zip((*net.points.id, *net.images.id), (*net.points.position, *net.images.position))
    for name, place in named:
        np.testing.assert_allclose(texts[name], place, rtol=1e-14, atol=1e-14)
    lost = names(said)
    assert "interior orientations" in lost and not lost & {"roles of points", "names of points"}


def test_csv_by_the_standard_library(tmp_path):
    net = full_network("brown")
    path, said = write("csv", net, tmp_path)
    with path.open(newline="", encoding="utf-8") as file:
        points = [*csv.DictReader(file)]
    with path.with_name("n_images.csv").open(newline="", encoding="utf-8") as file:
        images = [*csv.DictReader(file)]
    number = lambda text: {"": np.nan, "free": np.inf}.get(text) or float(text)
    column = lambda rows, *names: np.array([[number(r[n]) for n in names] for r in rows])
    assert [(r["id"], r["role"]) for r in points] == [*zip(net.points.id, net.points.role)]
    np.testing.assert_array_equal(column(points, "X", "Y", "Z"), net.points.position)
    np.testing.assert_array_equal(column(points, "sX", "sY", "sZ"), net.points.sigma)
    assert [r["camera"] for r in images] == [net.cameras[c].id for c in net.images.camera]
    np.testing.assert_array_equal(column(images, "X0", "Y0", "Z0"), net.images.position)
    np.testing.assert_allclose(column(images, "omega", "phi", "kappa"), net.images.angles, 1e-15)
    assert {"interior orientations", "image points"} <= names(said)


def test_kalibr_and_ros_by_pyyaml(tmp_path):
    """T_cn_cnm1 from the orientations of the first moment, by scipy alone."""
    net = full_network("opencv")
    path, _ = write("kalibr", net, tmp_path)
    chain = yaml.safe_load(path.read_text())
    flip = np.diag([1.0, -1, -1])
    R0, R1 = (flip @ conversions.matrix(a) for a in net.images.angles[:2])
    X0, X1 = net.images.position[:2]
    T = np.array(chain["cam1"]["T_cn_cnm1"])
    np.testing.assert_allclose(T[:3, :3], R1 @ R0.T, atol=1e-14)
    np.testing.assert_allclose(T[:3, 3], R1 @ (X0 - X1), atol=1e-14)
    for camera, given in zip(chain.values(), net.cameras):
        p = given.parameters
        assert camera["intrinsics"] == [p[k] for k in ("fx", "fy", "cx", "cy")]
        assert camera["distortion_coeffs"] == [p["k1"], p["k2"], p["p1"], 0.0]
        assert camera["resolution"] == [1280, 720]
    path, _ = write("ros-stereo", net, tmp_path)
    for given in net.cameras:
        found = yaml.safe_load((path / f"{given.id}.yaml").read_text())
        p = given.parameters
        assert found["camera_matrix"]["data"] == [p["fx"], 0, p["cx"], 0, p["fy"], p["cy"], 0, 0, 1]
        assert found["distortion_coefficients"]["data"] == [p["k1"], p["k2"], p["p1"], 0, 0]


@pytest.mark.parametrize("suffix", ["yaml", "json"])
def test_stereo_by_opencv(tmp_path, suffix):
    net = full_network("opencv")
    path = tmp_path / f"stereo.{suffix}"
    TARGETS["opencv-stereo"].write(net, path)
    file = cv2.FileStorage(str(path), cv2.FILE_STORAGE_READ)
    M1, D1, R, T, R1, P1 = (file.getNode(n).mat() for n in ("M1", "D1", "R", "T", "R1", "P1"))
    p = net.cameras[0].parameters
    assert [M1[0, 0], M1[1, 1], *M1[:2, 2]] == [p[k] for k in ("fx", "fy", "cx", "cy")]
    assert D1.ravel().tolist()[:3] == [p["k1"], p["k2"], p["p1"]]
    # a point in front of both cameras is on one row of both rectified images
    X = np.array([0.1, 0.2, 5.0])
    R2, P2 = file.getNode("R2").mat(), file.getNode("P2").mat()
    rows = [P @ [*(A @ Y), 1.0] for A, P, Y in ((R1, P1, X), (R2, P2, R @ X + T.ravel()))]
    # P2 has the shift of the base
    first, second = (R1 @ X, R2 @ (R @ X + T.ravel()))
    np.testing.assert_allclose(first[1:], second[1:], atol=1e-12)
    assert rows[0][2] == pytest.approx(first[2])


def test_colmap_itself_has_the_same_network(tmp_path):
    import pycolmap
    net = full_network("opencv")
    for kind in ("colmap", "colmap-text"):
        path, _ = write(kind, net, tmp_path)
        model = pycolmap.Reconstruction(path)
        assert {i.name for i in model.images.values()} == {*net.images.id}
        rows = {id: k for k, id in enumerate(net.images.id)}
        for image in model.images.values():
            mine = net.observations.image == rows[image.name]
            found = {p.point3D_id: p.xy - 0.5 for p in image.points2D}
            for p, xy in zip(net.observations.point[mine], net.observations.xy[mine]):
                np.testing.assert_allclose(found[p + 1], xy, rtol=1e-14)
                # the camera: the measurements are exact images of the points
                X = image.cam_from_world() * model.points3D[p + 1].xyz
                uv = image.camera.img_from_cam(X) - 0.5
                np.testing.assert_allclose(uv, xy, atol=1e-9)
        assert [p.track.length() for p in model.points3D.values()] == [4] * 12


def test_the_page_is_what_the_program_does():
    assert PAGE.read_text() == conversions.page(PAGE.read_text()), (
        "docs/conversions.md is old: python tests/io/conversions.py --write"
    )
    assert HOLDS.keys() <= FORMATS.keys()
    assert conversions.LETTERS.keys() | {*conversions.KINDS} == {*QUANTITIES}


@pytest.mark.parametrize("kind", [kind for kind in KINDS if kind in FORMATS])
def test_an_input_has_what_the_page_says(kind, tmp_path):
    made(kind, tmp_path)
    net = read(kind, tmp_path)
    if isinstance(net, Network):
        has = {name for name, count in QUANTITIES.items() if count(net)}
        assert has <= holds(kind)


def test_it_is_told_before_it_is_written(tmp_path, monkeypatch, capsys):
    from jaxbundle.io import convert, write_project

    write_project(full_network("opencv"), tmp_path / "given")
    seen = []
    tell = lambda lost: seen.append((lost, (tmp_path / "transforms.json").exists()))
    done = convert(tmp_path / "given", tmp_path / "transforms.json", tell=tell)
    ((lost, there),) = seen
    assert not there and lost == done.lost
    assert "points (12)" in lost and "distances (1)" in lost


def test_the_command_tells_it(command, tmp_path):
    from jaxbundle.io import write_project

    write_project(full_network("opencv"), tmp_path / "given")
    done = command("convert", tmp_path / "given", tmp_path / "m_colmap")
    assert "warning: not kept: names of cameras (2); pixel sizes of cameras (2);" in done.err
    assert "not kept: names of rigs and epochs, which are numbered\n" in done.out
    again = command("convert", tmp_path / "m_colmap", tmp_path / "camera.yaml", "--camera", "1")
    assert "image" in again.err and "points (12)" in again.err
    quiet = command("convert", tmp_path / "given", tmp_path / "n.ply", "--quiet")
    assert quiet.err == quiet.out == ""


def test_a_table_of_unknowns_is_told_to_be_one(command, tmp_path):
    """A project keeps start values empty on purpose."""
    from jaxbundle.io import write_project

    given = full_network("opencv")
    angles, position = given.images.angles.copy(), given.points.position.copy()
    angles[0], position[given.points.has_role("tie")] = np.nan, np.nan
    number = given.points.has_role("tie").sum()
    given = given.replace(
        images=dataclasses.replace(given.images, angles=angles),
        points=dataclasses.replace(given.points, position=position),
    )
    write_project(given, tmp_path / "given")
    done = command("convert", tmp_path / "given", tmp_path / "n.csv")
    without = f"1 image without orientation, {number} points without coordinates: "
    assert f"warning: {without}their cells are empty; convert the result of" in done.err
    copied = command("convert", tmp_path / "given", tmp_path / "copy")
    assert "without" not in copied.err + copied.out


@pytest.mark.parametrize("kind", CAMERA_KINDS)
def test_files_of_cameras(kind, tmp_path):
    from jaxbundle.io import read_cameras, read_network

    net = full_network("brown" if kind == "cameras" else "opencv")
    cameras = net.cameras[:1] if CAMERA_KINDS[kind].single else net.cameras
    name = {"colmap-cameras": "cameras.txt", "opensfm-cameras": "camera_models.json",
            "ros": "camera_info.yaml", "cameramodel": "x.cameramodel", "autocal": "autocal.xml",
            "opencv": "x.yaml", "cameras": "x.toml"}[kind]  # fmt: skip
    CAMERA_KINDS[kind].write(cameras, tmp_path / name)
    mrcal = kind == "cameramodel"  # is read as a network
    back = (read_network if mrcal else read_cameras)(tmp_path / name)
    back = back.cameras if mrcal else back
    lost = {
        "names of cameras": [c.id for c in back] != [c.id for c in cameras],
        "pixel sizes of cameras": any(c.pixel_size is None for c in back),
        "prior σ of camera parameters": not any(c.sigma for c in back),
    }
    said = names(describe_losses(net.replace(cameras=cameras), CAMERA_KINDS[kind].losses))
    assert said == {name for name, there in lost.items() if there}
