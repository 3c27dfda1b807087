"""transforms.json of nerfstudio and instant-ngp: the formula, by hand, there and back, broken."""

import json

import numpy as np
import pytest
from exchange_cases import ANGLES, POSITION, assert_same, matrix, network
from numpy.testing import assert_allclose

from jaxbundle.cameras import get_model
from jaxbundle.cameras.convert_fit import images_of
from jaxbundle.errors import InputError
from jaxbundle.io import convert, read_network, write_opencv
from jaxbundle.io.networks.assemble import all_parameters
from jaxbundle.io.networks.transforms import write_transforms

OPENCV = {
    "camera_model": "OPENCV", "w": 1280, "h": 720, "fl_x": 1000.0, "fl_y": 1002.0, "cx": 641.0,
    "cy": 358.5, "k1": -0.1, "k2": 0.02, "p1": 1e-3, "p2": -5e-4,
}  # fmt: skip
FISHEYE = OPENCV | {"camera_model": "OPENCV_FISHEYE", "k3": 1e-3, "k4": -1e-4}


def image_of(p, X, world_from_camera):
    """Where a point of the world is in the image, from the corner of the first pixel."""
    x, y, z = np.linalg.inv(world_from_camera)[:3] @ np.append(X, 1)  # x right, y up, z backward
    x, y = x / -z, -y / -z
    k = [p.get(f"k{i}", 0) for i in (1, 2, 3, 4)]
    if p["camera_model"] == "OPENCV_FISHEYE":
        r = np.hypot(x, y)
        theta = np.arctan(r)
        scale = theta * (1 + sum(a * theta ** (2 * i + 2) for i, a in enumerate(k))) / r
        x, y = x * scale, y * scale
    else:
        r2, p1, p2 = x * x + y * y, p["p1"], p["p2"]
        d = 1 + sum(a * r2 ** (i + 1) for i, a in enumerate(k))
        x, y = (x * d + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
                y * d + 2 * p2 * x * y + p1 * (r2 + 2 * y * y))  # fmt: skip
    return np.array([p["fl_x"] * x + p["cx"], p["fl_y"] * y + p["cy"]])


def frames(**more) -> list[dict]:
    made = []
    for i in range(3):
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = matrix(ANGLES[i]).T, POSITION[i]
        made.append({"file_path": f"images/{i}.png", "transform_matrix": T.tolist(), **more})
    return made


def read(tmp_path, document):
    path = tmp_path / "transforms.json"
    path.write_text(json.dumps(document))
    return read_network(path)


@pytest.mark.parametrize("given, limit", [
    (OPENCV, 1e-9), (FISHEYE, 1e-9), (OPENCV | {"k3": 0.01, "k4": -0.02}, 0.05),
])  # fmt: skip
def test_the_published_formula(tmp_path, given, limit):
    net = read(tmp_path, {**given, "frames": frames()})
    X = np.array([0.4, -0.5, 0.1])
    camera = net.cameras[0]
    for i in range(3):
        ray = matrix(net.images.angles[i]) @ (X - net.images.position[i])
        found = images_of(get_model(camera.model), all_parameters(camera), ray[None])[0]
        wanted = image_of(given, X, np.array(frames()[i]["transform_matrix"])) - 0.5
        assert_allclose(found, wanted, atol=limit)
    assert any("fitted" in told for told in net.warnings) == (limit > 1e-9)


def test_instant_ngp(tmp_path):
    given = {"camera_angle_x": 2 * np.arctan(0.64), "w": 1280, "h": 720, "aabb_scale": 4}
    net = read(tmp_path, given | {"scale": 0.33, "frames": frames()})
    p = all_parameters(net.cameras[0])
    assert [p[k] for k in ("fx", "fy", "cx", "cy")] == pytest.approx([1000, 1000, 639.5, 359.5])
    assert any("scale is not read: coordinates are those of" in told for told in net.warnings)
    net = read(tmp_path, given | {"is_fisheye": True, "fl_x": 700.0, "frames": frames(k1=0.1)})
    assert net.cameras[0].model == "kannala-brandt" and len(net.cameras) == 1
    assert net.cameras[0].parameters["k1"] == 0.1


def test_there_and_back(tmp_path):
    two = network("opencv", ("a", "b", "c"))
    camera = two.cameras[0]
    path = tmp_path / "transforms.json"
    lost = write_transforms(two, path)
    assert lost == ("names of cameras (1)", "pixel sizes of cameras (1)", "points (12)")
    back = read_network(path)
    assert_same(back, two.replace(points=back.points, observations=back.observations))
    document = json.loads(path.read_text())
    document["frames"][1]["fl_x"] = 900.0
    net = read(tmp_path, document)
    assert net.images.camera.tolist() == [0, 1, 0]
    made = convert(path, tmp_path / "transforms_2.json")
    assert made.kind == "transforms"
    assert_same(net, read_network(tmp_path / "transforms_2.json"))
    write_opencv(camera, tmp_path / "cam.yaml")
    convert(tmp_path / "cam.yaml", tmp_path / "transforms_3.json")
    (one,) = read_network(tmp_path / "transforms_3.json").cameras
    assert all_parameters(one) == all_parameters(camera)


BROKEN = {
    "no frames": (lambda d: d["frames"].clear(), "transforms.json: there are no frames"),
    "model": (lambda d: d.update(camera_model="EQUIRECTANGULAR"), "EQUIRECTANGULAR are not off"),
    "focal": (
        lambda d: [d.pop(name) for name in ("fl_x", "fl_y")], "fl_x and camera_angle_x are missing"
    ),
    "width": (lambda d: d.update(w=12.5), "w is 12.5; expected a whole number"),
    "matrix": (lambda d: d["frames"][1].update(transform_matrix=[[1, 2]]), r"s\[1\]: transform"),
    "mirror": (
        lambda d: d["frames"][1].update(transform_matrix=(-np.eye(4)).tolist()), "that mirrors"
    ),
    "NaN": (lambda d: d.update(k1=float("nan")), "k1 is nan"),
    "name": (lambda d: d["frames"][1].pop("file_path"), r"frames\[1\]: file_path is missing"),
    "twice": (lambda d: d["frames"].append(d["frames"][0]), "two frames have the file_path"),
}  # fmt: skip


@pytest.mark.parametrize("name", BROKEN)
def test_broken_files(tmp_path, name):
    change, message = BROKEN[name]
    document = {**OPENCV, "frames": frames()}
    change(document)
    if name == "no frames":
        document["frames"] = []
        document["frames_of"] = {"transform_matrix": 1}
    with pytest.raises(InputError, match=message):
        read(tmp_path, document)
