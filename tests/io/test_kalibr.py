"""Camera chains of Kalibr: its formulas for one point, mountings, there and back, broken files."""

import numpy as np
import pytest
from exchange_cases import assert_same, matrix
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from jaxbundle.cameras import get_model
from jaxbundle.cameras.convert_fit import images_of
from jaxbundle.errors import InputError
from jaxbundle.io import convert, read_network, write_opencv
from jaxbundle.io.networks.assemble import all_parameters
from jaxbundle.io.networks.kalibr import MODELS, write_kalibr

F = [460.0, 461.5, 362.5, 246.25]
INTRINSICS = {"pinhole": F, "omni": [0.8, *F], "eucm": [0.6, 1.1, *F], "ds": [-0.2, 0.55, *F]}
COEFFICIENTS = {"radtan": [-0.28, 0.07, 9e-4, -1e-4], "equi": [-0.03, 0.01, -2e-3, 5e-4],
                "fov": [0.93], "none": []}  # fmt: skip


def published(camera, distortion, X, Y, Z):
    """Kalibr's image of a point, as its wiki and the papers it names have it."""
    *own, fu, fv, pu, pv = INTRINSICS[camera]
    R = np.sqrt(X * X + Y * Y + Z * Z)
    if camera == "pinhole":
        N = Z
    elif camera == "omni":
        N = Z + own[0] * R
    elif camera == "eucm":
        alpha, beta = own
        N = alpha * np.sqrt(beta * (X * X + Y * Y) + Z * Z) + (1 - alpha) * Z
    else:
        xi, alpha = own
        d2 = np.sqrt(X * X + Y * Y + (xi * R + Z) ** 2)
        N = alpha * d2 + (1 - alpha) * (xi * R + Z)
    x, y = X / N, Y / N
    r, k = np.hypot(x, y), COEFFICIENTS[distortion]
    if distortion == "radtan":
        radial = 1 + k[0] * r**2 + k[1] * r**4
        x, y = (x * radial + 2 * k[2] * x * y + k[3] * (r**2 + 2 * x * x),
                y * radial + 2 * k[3] * x * y + k[2] * (r**2 + 2 * y * y))  # fmt: skip
    elif distortion == "equi":
        t = np.arctan(r)
        scale = t * (1 + sum(a * t ** (2 * i + 2) for i, a in enumerate(k))) / r
        x, y = x * scale, y * scale
    elif distortion == "fov":
        scale = np.arctan(2 * r * np.tan(k[0] / 2)) / k[0] / r
        x, y = x * scale, y * scale
    return fu * x + pu, fv * y + pv


T1 = np.eye(4)
T1[:3, :3] = Rotation.from_rotvec([0.02, -0.05, 0.01]).as_matrix()
T1[:3, 3] = [-0.11, 0.002, 0.003]
T2 = np.linalg.inv(T1) @ T1 @ T1


def chain(*kinds, mounted=True) -> str:
    text = ""
    for k, (camera, distortion) in enumerate(kinds):
        text += f"""cam{k}:
  cam_overlaps: [{1 - k}]
  camera_model: {camera}
  distortion_coeffs: {COEFFICIENTS[distortion]}
  distortion_model: {distortion}
  intrinsics: {INTRINSICS[camera]}
  resolution: [752, 480]
  rostopic: /cam{k}/image_raw
"""
        if k and mounted:
            text += "  T_cn_cnm1:\n" + "".join(f"  - {row.tolist()}\n" for row in (T1, T2)[k - 1])
    return text


def read(tmp_path, text):
    path = tmp_path / "camchain.yaml"
    path.write_text(text)
    return read_network(path)


@pytest.mark.parametrize("camera, distortion", MODELS)
def test_the_published_formula_is_the_camera(tmp_path, camera, distortion):
    (found,) = read(tmp_path, chain((camera, distortion))).cameras
    assert found.image_size == (752, 480) and found.id == "cam0"
    ray = np.array([0.2, -0.3, -1.1])
    uv = images_of(get_model(found.model), all_parameters(found), ray[None])[0]
    assert_allclose(uv, published(camera, distortion, ray[0], -ray[1], -ray[2]), atol=1e-9)
    again = read_network(convert(tmp_path / "camchain.yaml", tmp_path / "camchain2.yaml").path)
    assert all_parameters(again.cameras[0]) == all_parameters(found)


def test_a_chain_of_three_is_a_rig(tmp_path):
    net = read(tmp_path, chain(("pinhole", "radtan"), ("pinhole", "equi"), ("pinhole", "none")))
    (rig,) = net.further
    assert rig.image == ("cam0", "cam1", "cam2") and {*rig.epoch} == {"0"}
    X = np.array([0.3, 0.2, 2.0, 1.0])  # in the frame of the first, the world
    for k, T in enumerate((np.eye(4), T1, T2 @ T1)):
        ours = matrix(net.images.angles[k]) @ (X[:3] - net.images.position[k])
        assert_allclose(ours * [1, -1, -1], (T @ X)[:3], atol=1e-12)
    assert write_kalibr(net, tmp_path / "camchain2.yaml") == ()
    assert_same(net, read_network(tmp_path / "camchain2.yaml"))
    made = convert(tmp_path / "camchain.yaml", tmp_path / "project")
    assert "project" in str(made)
    alone = read(tmp_path, chain(("pinhole", "radtan"), ("pinhole", "equi"), mounted=False))
    # nothing relates the cameras: their places are unknown, not equal
    assert alone.further == () and np.isnan(alone.images.position).all()
    assert np.isnan(alone.images.angles).all() and "left without orientation" in alone.warnings[0]


def body_chain(key, turn, *, broken=False):
    """A chain whose cameras are placed in the body only; `turn`: how the transform is written."""
    text, in_body = chain(*[("pinhole", "none")] * 3, mounted=False), (T0, T1 @ T0, T2 @ T1 @ T0)
    for k, T in enumerate(in_body):
        rows = "".join(f"  - {row.tolist()}\n" for row in turn(T))
        if not (broken and k == 1):
            text = text.replace(f"  rostopic: /cam{k}", f"  {key}:\n{rows}  rostopic: /cam{k}")
    return text


T0 = np.eye(4)
T0[:3, :3] = Rotation.from_rotvec([0.3, 1.2, -0.4]).as_matrix()
T0[:3, 3] = [0.05, -0.02, 0.01]


@pytest.mark.parametrize("key, turn", [
    ("T_cam_imu", lambda T: T), ("T_imu_cam", np.linalg.inv), ("T_B_C", np.linalg.inv),
])  # fmt: skip
def test_poses_follow_from_those_in_the_body(tmp_path, key, turn):
    net = read(tmp_path, body_chain(key, turn))
    (rig,) = net.further
    assert rig.image == ("cam0", "cam1", "cam2")
    X = np.array([0.3, 0.2, 2.0, 1.0])  # in the frame of the first camera
    for k, T in enumerate((np.eye(4), T1, T2 @ T1)):
        ours = matrix(net.images.angles[k]) @ (X[:3] - net.images.position[k])
        assert_allclose(ours * [1, -1, -1], (T @ X)[:3], atol=1e-10)
    part = read(tmp_path, body_chain(key, turn, broken=True))
    assert part.further[0].image == ("cam0", "cam2")
    assert_allclose(part.images.position[[0, 2]], net.images.position[[0, 2]], atol=1e-12)
    assert np.isnan(part.images.position[1]).all() and "'cam1'" in str(part.warnings)


def test_a_camera_file_becomes_a_chain(tmp_path):
    net = read(tmp_path, chain(("pinhole", "equi")))
    write_opencv(net.cameras[0], tmp_path / "left.yaml")
    made = convert(tmp_path / "left.yaml", tmp_path / "my-camchain.yaml")
    assert made.kind == "kalibr" and made.lost == ("names of cameras (1)", "names of images (1)")
    (back,) = read_network(tmp_path / "my-camchain.yaml").cameras
    assert all_parameters(back) == all_parameters(net.cameras[0])
    convert(tmp_path / "my-camchain.yaml", tmp_path / "camera_info.yaml")
    assert "distortion_model: \"equidistant\"" in (tmp_path / "camera_info.yaml").read_text()


@pytest.mark.parametrize("name, values", [
    ("plumb_bob", [0.1, -0.2, 1e-3, 2e-3, 0.05]),
    ("rational_polynomial", [1.3, 0.35, 6e-5, 5e-5, 0.007, 1.7, 0.75, 0.05]),
])  # fmt: skip
def test_chains_with_the_coefficients_of_opencv(tmp_path, name, values):
    """Written by other programs, also without a camera_model."""
    text = chain(("pinhole", "radtan"), ("pinhole", "radtan"))
    text = text.replace("radtan", name).replace(str(COEFFICIENTS["radtan"]), str(values))
    net = read(tmp_path, text.replace("  camera_model: pinhole\n", ""))
    order = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
    assert [net.cameras[1].parameters[k] for k in order[: len(values)]] == values
    assert len(net.further) == 1


BROKEN = {
    "model": ("camera_model: pinhole", "camera_model: x", "camchain.yaml, cam0: camera_model x"),
    "missing": ("  intrinsics", "  intrinsic", "cam0: unknown key 'intrinsic'"),
    "short": ("intrinsics: [460.0, ", "intrinsics: [", "cam0: intrinsics is .* 4 of finite"),
    "NaN": ("[460.0, ", "[.nan, ", "cam0: intrinsics is"),
    "coefficients": ("[-0.28, ", "[", "cam0: distortion_coeffs is"),
    "size": ("[752, 480]", "[752.5, 480]", "resolution: w is 752.5"),
    "no size": ("  resolution", "  size", "cam0: resolution is missing"),
    "rows": ("  - [0.0, 0.0, 0.0, 1.0]\n", "", "cam1: T_cn_cnm1 is .* 4 × 4"),
    "mirror": ("  - [0.99", "  - [-0.99", "cam1: T_cn_cnm1 is not a rotation"),
    "yaml": ("cam1:", "cam0:", "line 9: .*cam0 occurs twice"),
}


@pytest.mark.parametrize("name", BROKEN)
def test_broken_chains(tmp_path, name):
    old, new, message = BROKEN[name]
    text = chain(("pinhole", "radtan"), ("pinhole", "equi"))
    assert old in text
    with pytest.raises(InputError, match=message):
        read(tmp_path, text.replace(old, new, 1))
