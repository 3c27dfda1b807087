"""Rigs and frames of COLMAP: what is written gives every image its orientation as frame and sensor
together, which is what COLMAP takes."""

import dataclasses
import struct

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxbundle.io import read_network
from jaxbundle.io.networks.colmap import write_colmap
from jaxbundle.network import Camera
from jaxbundle.network.build import make_network
from jaxbundle.network.columns import Columns
from jaxbundle.network.kinds import Rigs
from jaxbundle.network.tables import Source

PARAMETERS = dict(fx=900.0, fy=900.0, cx=640.0, cy=360.0, k1=-0.1)
IMAGES = ("l0", "r0", "l1", "r1", "r2", "alone")
CAMERAS = ("left", "right", "left", "right", "right", "third")
ROWS = [("pair", "0", "l0"), ("pair", "0", "r0"), ("pair", "1", "l1"), ("pair", "1", "r1")]


def matrix(angles):
    return Rotation.from_euler("xyz", -np.asarray(angles)).as_matrix()


def scene(rows=ROWS, **changes):
    """Two cameras at two moments, the right one once more alone, and a camera of its own."""
    rng = np.random.default_rng(3)
    D, t = matrix([0.1, -0.2, 0.3]), np.array([0.3, 0.05, -0.02])
    poses = {name: (matrix(rng.normal(size=3)), rng.normal(size=3)) for name in IMAGES}
    for k in "01":
        M, X0 = poses[f"l{k}"]
        poses[f"r{k}"] = (D @ M, X0 + M.T @ t)
    images = []
    for name, camera in zip(IMAGES, CAMERAS):
        M, X0 = poses[name]
        angles = -Rotation.from_matrix(M).as_euler("xyz")
        columns = ("X0", "Y0", "Z0", "omega", "phi", "kappa")
        images.append({"id": name, "camera": camera, **dict(zip(columns, (*X0, *angles)))})
    net = make_network(
        [Camera(id, "opencv", PARAMETERS, image_size=(1280, 720)) for id in dict.fromkeys(CAMERAS)],
        images,
        [{"id": str(k), "role": "tie", **dict(zip("XYZ", rng.normal(size=3)))} for k in (1, 2)],
        [{"image": i, "point": p, "x": 5.0 + k, "y": 7.0} for k, i in enumerate(IMAGES)
         for p in ("1", "2")],
        image_unit="px", datum="inner", residuals="measured",
    )  # fmt: skip
    rig, epoch, image = zip(*rows)
    columns = Columns({"rig": rig, "epoch": epoch, "image": image}, Source("rigs"))
    return net.replace(further=(Rigs.from_columns(columns, {}, 1.0),), **changes)


def poses_of_text(folder):
    """R, t of the images by number, from rigs.txt and frames.txt alone."""
    words = lambda name: [line.split() for line in (folder / name).read_text().splitlines()
                          if line[0] != "#"]  # fmt: skip
    pose = lambda w: (Rotation.from_quat([*map(float, w[1:4]), float(w[0])]).as_matrix(),
                      np.array(w[4:7], float))  # fmt: skip
    sensors = {}
    for w in words("rigs.txt"):
        rig, n, kind, reference = w[:4]
        assert kind == "CAMERA" and len(w) == 4 + 10 * (int(n) - 1)
        sensors[rig, reference] = (np.eye(3), np.zeros(3))
        for k in range(4, len(w), 10):
            assert w[k] == "CAMERA" and w[k + 2] == "1"
            sensors[rig, w[k + 1]] = pose(w[k + 3 :])
    found = {}
    for w in words("frames.txt"):
        R, t = pose(w[2:])
        assert len(w) == 10 + 3 * int(w[9])
        for k in range(10, len(w), 3):
            Rs, ts = sensors[w[1], w[k + 1]]
            assert w[k + 2] not in found
            found[w[k + 2]] = (Rs @ R, Rs @ t + ts)
    return found


def assert_poses(net, found, limit=1e-14):
    assert {*found} == {str(k + 1) for k in range(len(net.images))}
    for k, (R, t) in found.items():
        i = int(k) - 1
        M = np.diag([1, -1, -1]) @ matrix(net.images.angles[i])
        np.testing.assert_allclose(R, M, atol=limit)
        np.testing.assert_allclose(t, -M @ net.images.position[i], atol=limit)


def test_frames_and_sensors_give_the_orientations(tmp_path):
    net = scene()
    lost = write_colmap(net, tmp_path / "m", text=True)
    assert not any("rig" in what and "names" not in what for what in lost)
    assert_poses(net, poses_of_text(tmp_path / "m"))
    assert len((tmp_path / "m" / "frames.txt").read_text().splitlines()) == 1 + 4


@pytest.mark.parametrize("text", [True, False])
def test_they_come_back(tmp_path, text):
    rows = [("4", e, i) for e, i in zip(("9", "9", "3", "3"), IMAGES)]
    net = scene(rows)
    assert not any("rig" in what for what in write_colmap(net, tmp_path / "m", text=text))
    back = read_network(tmp_path / "m")
    (rigs,) = back.further
    assert sorted(zip(rigs.rig, rigs.epoch, rigs.image)) == sorted(rows)
    assert back.images.id == net.images.id


def test_binary_and_text_hold_the_same(tmp_path):
    write_colmap(scene(), tmp_path / "b", text=False)
    write_colmap(scene(), tmp_path / "t", text=True)
    frames = (tmp_path / "b" / "frames.bin").read_bytes()
    numbers = [float(w) for line in (tmp_path / "t" / "frames.txt").read_text().splitlines()[1:]
               for w in line.replace("CAMERA", "0").split()]  # fmt: skip
    position, found = 8, []
    for _ in range(struct.unpack_from("<Q", frames)[0]):
        head = struct.unpack_from("<II7dI", frames, position)
        position += struct.calcsize("<II7dI")
        found += head
        for _ in range(head[-1]):
            found += struct.unpack_from("<iIQ", frames, position)
            position += 16
    assert position == len(frames) and found == numbers


def test_what_colmap_cannot_hold_is_told(tmp_path):
    net = scene()
    position = net.images.position.copy()
    position[3] += [0.0, 0.25, 0.0]
    moved = net.replace(images=dataclasses.replace(net.images, position=position))
    (told,) = (w for w in write_colmap(moved, tmp_path / "a") if "contradict" in w)
    assert "up to 0.25 and" in told
    twice = scene([*ROWS, ("other", "0", "r2"), ("other", "0", "alone")])
    lost = write_colmap(twice, tmp_path / "b", text=True)
    assert "the rig of 2 images" in lost
    assert_poses(twice, poses_of_text(tmp_path / "b"))


def test_cameras_that_meet_only_by_way_of_a_third(tmp_path):
    """Left and third never meet: the mounting of the third follows from both with the right one."""
    rows = [*ROWS, ("pair", "2", "r2"), ("pair", "2", "alone")]
    net = scene(rows)
    write_colmap(net, tmp_path / "m", text=True)
    assert "1 3 CAMERA 2 CAMERA 1 1" in (tmp_path / "m" / "rigs.txt").read_text()
    assert_poses(net, poses_of_text(tmp_path / "m"))


@pytest.mark.parametrize("text", [True, False])
def test_colmap_reads_the_same(tmp_path, text):
    import pycolmap
    net = scene()
    write_colmap(net, tmp_path / "m", text=text)
    model = pycolmap.Reconstruction(tmp_path / "m")
    assert sorted(len(rig.non_ref_sensors) for rig in model.rigs.values()) == [0, 1]
    assert len(model.frames) == 4
    found = {str(k): (image.cam_from_world().rotation.matrix(), image.cam_from_world().translation)
             for k, image in model.images.items()}  # fmt: skip
    assert_poses(net, found)
