"""openMVG's scenes: its own formula for one point, a scene written by hand, there and back."""

import copy
import dataclasses
import json

import numpy as np
import pytest
from exchange_cases import ANGLES, POINTS, POSITION, assert_same, matrix, network
from numpy.testing import assert_allclose

import jaxbundle
from jaxbundle.cameras import get_model
from jaxbundle.cameras.convert_fit import images_of
from jaxbundle.errors import InputError
from jaxbundle.io import convert, read_network
from jaxbundle.io.networks.assemble import all_parameters
from jaxbundle.io.networks.openmvg import read_openmvg, write_openmvg

K = {"disto_t2": [-0.1, 0.02, 0.003, 1e-3, -5e-4], "fisheye": [0.05, 0.01, -0.002, 0.001]}


def published(kind, X, Y, Z):
    """openMVG's image of a point of the camera frame, as its documentation has it."""
    f, (ppx, ppy), (x, y) = 1000.0, (641.0, 358.5), (X / Z, Y / Z)
    r2 = x * x + y * y
    if kind == "fisheye":
        theta = np.arctan(np.sqrt(r2))
        k = theta + sum(a * theta ** (2 * i + 3) for i, a in enumerate(K["fisheye"]))
        x, y = x * k / np.sqrt(r2), y * k / np.sqrt(r2)
    else:
        given = COEFFICIENTS[kind].values()
        k1, k2, k3, t1, t2 = ([k for one in given for k in one] + [0] * 5)[:5]
        k = k1 * r2 + k2 * r2**2 + k3 * r2**3
        x, y = (x + x * k + t2 * (r2 + 2 * x * x) + 2 * t1 * x * y,
                y + y * k + t1 * (r2 + 2 * y * y) + 2 * t2 * x * y)  # fmt: skip
    return f * x + ppx, f * y + ppy


COEFFICIENTS = {
    "pinhole": {}, "pinhole_radial_k1": {"disto_k1": [-0.1]},
    "pinhole_radial_k3": {"disto_k3": [-0.1, 0.02, 0.003]},
    "pinhole_brown_t2": {"disto_t2": K["disto_t2"]}, "fisheye": {"fisheye": K["fisheye"]},
}  # fmt: skip


def scene(kind="pinhole_brown_t2", nested=False) -> dict:
    """The three images and twelve points of `exchange_cases`, with a view without pose, one of a
    sphere, and the first three points as control too."""
    core = {"width": 1280, "height": 720, "focal_length": 1000.0, "principal_point": [641.0, 358.5]}
    data = {"value0": core} | COEFFICIENTS[kind] if nested else core | COEFFICIENTS[kind]
    view = lambda k, camera: {"key": k, "value": {"polymorphic_id": 2**30, "ptr_wrapper": {
        "id": 2**31 + k, "data": {"local_path": "", "filename": f"{k}.jpg", "width": 1280,
                                  "height": 720, "id_view": k, "id_intrinsic": camera,
                                  "id_pose": k}}}}  # fmt: skip
    intrinsics = [{"key": k, "value": {
        "polymorphic_id": 1 + 2**31 * (k == 0), **({"polymorphic_name": kind} if k == 0 else {}),
        "ptr_wrapper": {"id": 2**31 + 9 + k, "data": data},
    }} for k in (0, 1)]  # fmt: skip
    intrinsics.append({"key": 2, "value": {"polymorphic_id": 2**31 + 2,
                                           "polymorphic_name": "spherical",
                                           "ptr_wrapper": {"id": 2**31 + 12, "data": {}}}})
    R = [matrix(a) * np.array([[1], [-1], [-1]]) for a in ANGLES]
    image = lambda i, X: [*map(float, published(kind, *(R[i] @ (X - POSITION[i]))))]
    seen = lambda X: [{"key": i, "value": {"id_feat": 0, "x": image(i, X)}} for i in range(3)]
    entry = lambda k: {"key": k, "value": {"X": POINTS[k].tolist(),
                                           "observations": seen(POINTS[k])}}  # fmt: skip
    return {
        "sfm_data_version": "0.3", "root_path": "/", "intrinsics": intrinsics,
        "views": [view(0, 0), view(1, 0), view(2, 1), view(3, 0), view(4, 2)],
        "extrinsics": [{"key": i, "value": {"rotation": R[i].tolist(),
                                            "center": POSITION[i].tolist()}} for i in range(3)],
        "structure": [entry(k) for k in range(12)], "control_points": [entry(k) for k in range(3)],
    }  # fmt: skip


def read(tmp_path, document):
    path = tmp_path / "sfm_data.json"
    path.write_text(json.dumps(document))
    return read_network(path)


@pytest.mark.parametrize("kind", COEFFICIENTS)
def test_the_published_formula_is_the_camera(tmp_path, kind):
    net = read(tmp_path, scene(kind, nested=kind == "fisheye"))
    camera = net.cameras[0]
    assert camera.tie == (("fx", "fy"),) and camera.image_size == (1280, 720)
    ray = np.array([0.2, -0.3, -1.1])
    found = images_of(get_model(camera.model), all_parameters(camera), ray[None])[0]
    assert_allclose(found, published(kind, ray[0], -ray[1], -ray[2]), atol=1e-9)


def test_a_scene(tmp_path):
    net = read(tmp_path, scene())
    assert net.images.id == ("0.jpg", "1.jpg", "2.jpg") and net.images.camera.tolist() == [0, 0, 1]
    assert_allclose(net.images.position, POSITION, atol=1e-12)
    assert_allclose([matrix(a) for a in net.images.angles], [matrix(a) for a in ANGLES], atol=1e-12)
    assert_allclose(net.points.position, np.concatenate([POINTS, POINTS[:3]]), atol=1e-12)
    assert net.points.role == ("tie",) * 12 + ("control",) * 3 and net.datum == "control"
    assert net.points.id[12:] == ("control 0", "control 1", "control 2")
    told = " ".join(net.warnings)
    assert "'4.jpg'" in told and "'3.jpg'" in told and "without pose" in told
    result = jaxbundle.adjust(net)
    assert result.converged and result.sigma0 < 1e-6


def test_there_and_back(tmp_path):
    net = network("opencv", ("a.jpg", "b.jpg", "c.jpg"))
    camera = net.cameras[0]
    with pytest.raises(InputError, match="fx is 1000 and fy 1002"):
        write_openmvg(net, tmp_path / "sfm_data.json")
    square = dataclasses.replace(camera, id="0", parameters=dict(camera.parameters, fy=1000.0))
    net = net.replace(cameras=(square,))
    assert write_openmvg(net, tmp_path / "sfm_data.json") == ("pixel sizes of cameras (1)",)
    back = read_openmvg(tmp_path / "sfm_data.json")
    assert_same(net, back)
    made = convert(tmp_path / "sfm_data.json", tmp_path / "again_sfm_data.json")
    assert made.kind == "openmvg" and made.lost == ()
    assert_same(net, read_openmvg(tmp_path / "again_sfm_data.json"))


BROKEN = {
    "version": (lambda d: d.pop("sfm_data_version"), "not recognised"),
    "kind": (lambda d: d["intrinsics"][0]["value"].update(polymorphic_name="x"), "camera is x"),
    "coefficients": (
        lambda d: d["intrinsics"][0]["value"]["ptr_wrapper"]["data"]["disto_t2"].pop(), "disto_t2"
    ),
    "focal": (
        lambda d: d["intrinsics"][0]["value"]["ptr_wrapper"]["data"].pop("focal_length"),
        "focal_length is missing",
    ),
    "camera": (lambda d: d["intrinsics"].pop(1), "id_intrinsic 1 is not"),
    "rotation": (lambda d: d["extrinsics"][1]["value"]["rotation"].pop(), r"s\[1\].*rotation"),
    "mirrored": (
        lambda d: d["extrinsics"][1]["value"].update(rotation=(-np.eye(3)).tolist()), "not a rotat"
    ),
    "NaN": (
        lambda d: d["structure"][1]["value"].update(X=[0, float("nan"), 1]), "X is .* 3 of finite"
    ),
    "x": (
        lambda d: d["structure"][1]["value"]["observations"][2]["value"].update(x=[1, 2, 3]),
        "point 1, view 2: x is",
    ),
    "twice": (lambda d: d["views"].append(d["views"][0]), "key 0 occurs twice"),
}  # fmt: skip


@pytest.mark.parametrize("name", BROKEN)
def test_broken_scenes(tmp_path, name):
    change, message = BROKEN[name]
    document = copy.deepcopy(scene())
    change(document)
    with pytest.raises(InputError, match=message) as caught:
        read(tmp_path, document)
    assert "sfm_data.json" in str(caught.value)


def test_a_scene_of_spherical_cameras(tmp_path):
    """Image points by openMVG's formula, in its mirrored frame: the network read fits them."""
    document = scene()
    size = (1000, 500)
    document["intrinsics"] = [{"key": 0, "value": {
        "polymorphic_id": 2**31 + 1, "polymorphic_name": "spherical",
        "ptr_wrapper": {"id": 2**31 + 9, "data": {"value0": {"width": size[0], "height": size[1]}}},
    }}]  # fmt: skip
    document["views"] = document["views"][:3]
    for view in document["views"]:
        view["value"]["ptr_wrapper"]["data"]["id_intrinsic"] = 0
    document["control_points"] = []
    R, X0 = (np.array([one["value"][name] for one in document["extrinsics"]])
             for name in ("rotation", "center"))  # fmt: skip
    for point in document["structure"]:
        for row in point["value"]["observations"]:
            i = row["key"]
            x, y, z = R[i] @ (np.array(point["value"]["X"]) - X0[i])
            angles = np.arctan2(x, z), np.arctan2(-y, np.hypot(x, z))
            row["value"]["x"] = [n / 2 + 1000 * a / (2 * np.pi) for n, a in zip(size, angles)]
    net = read(tmp_path, document)
    assert net.cameras[0].model == "equirectangular" and "mirror image" in " ".join(net.warnings)
    assert_allclose(net.points.position, POINTS * [1, -1, 1], atol=1e-12)
    result = jaxbundle.adjust(net)
    assert result.converged and result.sigma0 < 1e-6
    document["intrinsics"][0]["value"]["ptr_wrapper"]["data"] = {}
    with pytest.raises(InputError, match="width is missing"):
        read(tmp_path, document)
