"""Cameras and networks of further programs: their own formulas and conventions for one point, and
the ways in which public files spell the entries of a camera."""

import json
from pathlib import Path

import numpy as np
import pytest
from foreign_samples import ALICEVISION, NVM, OPENCV, OST, STEREO, write_sample
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

import jaxbundle
from jaxbundle.cameras import get_model
from jaxbundle.cameras.convert_fit import images_of
from jaxbundle.errors import InputError
from jaxbundle.io import read_cameras, read_network
from jaxbundle.io.cameras.camera_files import is_camera_file
from jaxbundle.io.cameras.nearest_camera import fit_messages
from jaxbundle.io.networks.assemble import all_parameters

K = [[500.0, 0, 320.5], [0, 501.0, 241.25], [0, 0, 1]]
D = [-0.3, 0.1, 0.001, -0.0005, 0.02]
NAMED = dict(zip(("k1", "k2", "p1", "p2", "k3"), D))


def image(camera, X, Y, Z):
    """The image of a ray, right, down, forward."""
    return images_of(
        get_model(camera.model), all_parameters(camera), np.array([[X, -Y, -Z]], float)
    )[0]


def pose(network, id):
    """R and t of x = R·X + t, x right, y down, z forward."""
    i = network.images.id.index(id)
    M = Rotation.from_euler("xyz", -network.images.angles[i]).as_matrix()
    R = np.diag([1, -1, -1]) @ M
    return R, -R @ network.images.position[i]


def read_one(tmp_path, document, name="camera.json"):
    (tmp_path / name).write_text(json.dumps(document))
    (camera,) = read_cameras(tmp_path / name)
    return camera


@pytest.mark.parametrize("key", [
    "dist_coeffs", "distCoeffs", "DistCoeffs", "D", "d", "dist", "Distortion", "distortion",
    "distortion_coeffs", "distortionCoefficients", "distortion_parameters", "distortion_coefs",
    "Distortion_Parameters", "distortion_vector", "dist_coeff", "distCoef", "distort", "distParams",
    "camera_distortion", "distortion_coefficient", "DISTORTION_COEFFICIENTS", "coeffs",
    "lens_distortion", "radial_distortion_coefficients", "cam_dist",
])  # fmt: skip
def test_the_distortion_is_never_dropped(tmp_path, key):
    for value in (D, [D], [[x] for x in D], NAMED, {"rows": 1, "cols": 5, "data": D}):
        camera = read_one(tmp_path, {"camera_matrix": K, key: value})
        assert {name: camera.parameters[name] for name in NAMED} == NAMED
    for value in ("many", 7, [1, 2, 3], {"a": 1}, True):
        with pytest.raises(InputError, match="camera.json: "):
            read_one(tmp_path, {"camera_matrix": K, key: value})


@pytest.mark.parametrize("document", [
    {"mtx": K, "dist": [D]}, {"K": sum(K, []), **NAMED}, {"intrinsic_matrix": K, "D": D},
    {"fx": 500, "fy": 501, "cx": 320.5, "cy": 241.25, **NAMED},
    {"FX": 500, "FY": 501, "CX": 320.5, "CY": 241.25, **{k.upper(): v for k, v in NAMED.items()}},
    {"intrinsics": {"fx": 500, "fy": 501, "ppx": 320.5, "ppy": 241.25}, "distortion": D},
    {"intrinsics": [500, 501, 320.5, 241.25], "distortion_coefficients": D},
    {"intrinsic": {"camera_matrix": K, "distortion_coeffs": D}, "extrinsic": {"tvec": [0, 0, 1]}},
    {"camera": {"K": K, "dist": D}, "software": "x"}, {"left": {"K": K, "dist": D}},
    {"camera_matrix": K, "distortion": {"model": "plumb_bob", "coefficients": D}},
    {"camera_matrix": K, "dist": D, "fx": 500.0, "fy": 501.0},
    {"camera_matrix": K, "dist": D, "model": "HERO7 Black"},
    {"camera_matrix": K, "dist": D, "camera_name": "left", "cam_id": 0},
])  # fmt: skip
def test_spellings_of_one_camera(tmp_path, document):
    camera = read_one(tmp_path, document)
    expected = {"fx": 500, "fy": 501, "cx": 320.5, "cy": 241.25} | NAMED
    assert {name: camera.parameters[name] for name in expected} == expected
    assert camera.model == "opencv"


@pytest.mark.parametrize("document, message", [
    ({"K": K, "D": D, "dist": [0.1, 0, 0, 0]}, "D and dist are both the distortion coefficients"),
    ({"K": K, "dist": D, "k1": 0.5}, "dist and k1 differ"),
    ({"K": K, "D": D, "distortion_model": "thin_prism"}, "distortion_model 'thin_prism'"),
    ({"K": K, "D": D, "distortion_model": "polynomial_9"}, "distortion_model 'polynomial_9'"),
    ({"K": K, "D": D, "model": "omnidirectional"}, "model 'omnidirectional' is not known"),
    ({"K": K, "D": D, "distortion_model": "inverse_brown_conrady"}, "is not known here"),
    ({"K": K, "D": D, "fx": 600.0}, "fx is 600, but K has 500"),
    ({"K": K, "D": D, "roi": [1, 2, 3, 4]}, "roi is"),
    ({"K": K, "D": D, "undistort": True}, "unknown key 'undistort'"),
    ({"K": K, "D": D, "skew": 0.1}, "skew or a tilted sensor.*image size is needed"),
    ({"K": K, "D": D, "width": 640, "height": 480, "roi": {"x_offset": 600, "width": 100}},
     "roi of 100 × 480 px at .600, 0. is not inside"),
    ({"K": K, "D": D, "roi": {"x_offset": 6}}, "roi needs the size"),
    ({"K": K, "D": D, "binning_x": -1}, "binning_x is -1"),
])  # fmt: skip
def test_contradictions_are_refused(tmp_path, document, message):
    with pytest.raises(InputError, match=message):
        read_one(tmp_path, document)


@pytest.mark.parametrize("xi, skew", [(0.95, 0.0), ([[1.3]], 0.0), (0.95, 0.4)])
def test_an_omnidirectional_camera_of_opencv(tmp_path, xi, skew):
    """A ray of length 1, divided by Z + ξ, distorted, times K (OpenCV contrib, omnidir)."""
    matrix = [[500, skew, 320.5], [0, 501, 241.25], [0, 0, 1]]
    camera = read_one(tmp_path, {"K": matrix, "D": D[:4], "xi": xi, "image_size": [640, 480]})
    X = np.array([[0.1, -0.2, 1], [-0.9, 0.4, 0.8], [0.5, 0.7, 0.2]])
    Xs = X / np.linalg.norm(X, axis=1, keepdims=True)
    x, y = (Xs[:, :2] / (Xs[:, 2:] + np.ravel(xi)[0])).T
    k1, k2, p1, p2 = D[:4]
    r2 = x * x + y * y
    xd = x * (1 + k1 * r2 + k2 * r2**2) + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
    yd = y * (1 + k1 * r2 + k2 * r2**2) + 2 * p2 * x * y + p1 * (r2 + 2 * y * y)
    uv = (np.stack([xd, yd, np.ones(3)], 1) @ np.array(matrix).T)[:, :2]
    found = images_of(get_model(camera.model), camera.parameters, X * [1, -1, -1])
    assert camera.model == "mei"
    # a skew of 0.4 moves no image point by more: |y'| < 1
    np.testing.assert_allclose(found, uv, rtol=0, atol=0.4 if skew else 1e-10)


@pytest.mark.parametrize("more, message", [
    ({"alpha": 0.6}, "xi and alpha are a double sphere"), ({"D": D[:4] + [0.1]}, "has 4"),
    ({"model": "ds"}, "'ds' with xi is not known"), ({"xi": [1, 2]}, "xi has 2 values"),
    ({"distortion_model": "equidistant"}, "'equidistant' with xi"),
])  # fmt: skip
def test_what_is_no_omnidirectional_camera_of_opencv(tmp_path, more, message):
    with pytest.raises(InputError, match=message):
        read_one(tmp_path, {"K": K, "D": D[:4], "xi": 0.9} | more)


def test_region_and_binning_of_ros(tmp_path):
    """image_geometry: the region is cut, then its pixels are binned."""
    text = OPENCV.replace("@", "") + (
        "binning_x: 2\nbinning_y: 4\n"
        "roi: {x_offset: 100, y_offset: 50, width: 400, height: 300, do_rectify: false}\n"
    )
    (tmp_path / "info.yaml").write_text(text)
    (camera,) = read_cameras(tmp_path / "info.yaml")
    p = camera.parameters
    assert camera.image_size == (200, 75) and (p["fx"], p["fy"]) == (250, 501 / 4)
    assert (p["cx"], p["cy"]) == ((320.5 - 100) / 2, (241.25 - 50) / 4) and p["k1"] == -0.3
    assert "roi and binning are applied" in fit_messages([camera])[0]
    camera = read_one(tmp_path, {"K": K, "D": D, "binning_x": 2})
    assert camera.image_size is None and "binning are applied" in fit_messages([camera])[0]
    (tmp_path / "info.yaml").write_text(OPENCV.replace("@", "") + "binning_x: 0\nroi: {width: 0}\n")
    (whole,) = read_cameras(tmp_path / "info.yaml")
    assert whole.image_size == (640, 480) and whole.parameters["cx"] == 320.5


def test_ost_of_two_cameras(tmp_path):
    """Their mounting follows from rectification and projection, as in camera_info."""
    R = Rotation.from_rotvec([0.01, 0.02, -0.01]).as_matrix()
    turn = "\n".join(" ".join(map(repr, row)) for row in R.tolist())
    projection = "\nprojection\n480.0 0.0 320.0 {}\n0.0 480.0 240.0 0.0\n0.0 0.0 1.0 0.0\n"
    head, own = OST.replace("@", "").split("[narrow_stereo]")
    level = own.split("rectification\n")[1].strip()
    one = f"[left]{own}{projection.format(0.0)}"
    two = f"[right]{own.replace(level, turn)}{projection.format(-57.6)}".replace("501.0", "502.0")
    for name in ("ost.ini", "ost.txt"):
        path = tmp_path / name
        # the program prints both twice
        path.write_text(head + one + "\n" + two + head + one + "\n" + two)
        assert not is_camera_file(path)
        net = read_network(path)
        assert [c.id for c in net.cameras] == ["left", "right"]
        assert [c.parameters["fy"] for c in net.cameras] == [501, 502]
        found = pose(net, "right")
        assert_allclose(found[0], R.T, atol=1e-12)
        assert_allclose(found[1], R.T @ [-0.12, 0, 0], atol=1e-12)
    path.write_text(head + one + "\n" + two.replace("projection", "projected"))
    with pytest.raises(InputError, match="right.*projection_matrix is missing"):
        read_network(path)


RENAMED = [
    ("K1 D1 K2 D2 R T", "image_size"), ("M1 D1 M2 D2 R T", "size"),
    ("cameraMatrix1 distCoeffs1 cameraMatrix2 distCoeffs2 R T", "imageSize"),
    ("camera_matrix_left dist_coeffs_left camera_matrix_right dist_coeffs_right rotation_matrix "
     "translation_vector", "image_size"),
    ("left_camera_matrix left_distortion_coefficients right_camera_matrix "
     "right_distortion_coefficients rotation translation", "resolution"),
    ("mtxL distL mtxR distR Rot Trns", "image_size"), ("K_l D_l K_r D_r R t", "image_size"),
    ("LEFT.K LEFT.D RIGHT.K RIGHT.D R T", "image_size"), ("K0 D0 K1 D1 R T", "image_size"),
]  # fmt: skip


@pytest.mark.parametrize("names, size", RENAMED)
def test_pairs_by_any_name(tmp_path, names, size):
    text = STEREO.replace("@", "").replace("image_size", size)
    new = dict(zip("K1 D1 K2 D2 R T".split(), names.split()))
    lines = [line.partition(":") for line in text.splitlines()]
    text = "\n".join(f"{new.get(key, key)}{colon}{rest}" for key, colon, rest in lines)
    path = tmp_path / "stereo.yaml"
    path.write_text(text)
    if "Trns" in names:
        with pytest.raises(InputError, match="Rot without the other"):
            read_network(path)
        return
    assert not is_camera_file(path)
    net = read_network(path)
    assert [c.parameters["fx"] for c in net.cameras] == [500, 510] and len(net.further) == 1
    assert [c.parameters["k1"] for c in net.cameras] == [-0.3, -0.2]
    assert_allclose(pose(net, net.images.id[1])[1], [-0.12, 0, 0], atol=1e-12)
    poses = names.split()[4:]
    unposed = [line for line in text.splitlines() if line.partition(":")[0] not in poses]
    path.write_text("\n".join(unposed))
    alone = read_network(path)
    assert np.isnan(alone.images.position).all() and not alone.further
    assert any("without a pose" in told for told in alone.warnings)


def test_nested_cameras_have_their_poses(tmp_path):
    turn = Rotation.from_rotvec([0.1, -0.2, 0.3])
    R, t = turn.as_matrix(), np.array([0.3, -0.1, 0.2])
    cameras = {
        "cam_a": {"K": K, "dist": D, "R": np.eye(3).tolist(), "T": [0, 0, 0]},
        "cam_b": {"K": K, "dist": D, "rvec": turn.as_rotvec().tolist(), "tvec": t.tolist()},
        "cam_c": {"K": K, "dist": D, "T": np.vstack([np.c_[R, t], [0, 0, 0, 1]]).tolist()},
        "cam_d": {"K": K, "dist": D},
    }
    path = tmp_path / "rig.json"
    path.write_text(json.dumps({"cameras": cameras, "rms": 0.3}))
    net = read_network(path)
    assert net.images.id == tuple(cameras)
    for id in ("cam_b", "cam_c"):
        found = pose(net, id)
        assert_allclose(found[0], R, atol=1e-12)
        assert_allclose(found[1], t, atol=1e-12)
    assert np.isnan(net.images.position[3]).all() and net.further[0].image == tuple(cameras)[:3]
    del cameras["cam_b"]["tvec"]
    path.write_text(json.dumps(cameras))
    with pytest.raises(InputError, match="cam_b: rvec without the other of R and T"):
        read_network(path)


def test_several_cameras_alone_have_no_place(tmp_path):
    cameras = '[[camera]]\nid = "a"\nmodel = "opencv"\nfx = 50.0\nfy = 50.0\nimage_size = [9, 9]\n'
    (tmp_path / "two.toml").write_text(cameras + cameras.replace('"a"', '"b"'))
    made = jaxbundle.io.convert(tmp_path / "two.toml", tmp_path / "camchain.yaml")
    assert "mountings of the cameras" in made.lost
    assert "T_cn_cnm1" not in (tmp_path / "camchain.yaml").read_text()
    with pytest.raises(InputError, match="has no orientation"):
        jaxbundle.io.convert(tmp_path / "two.toml", tmp_path / "mrcal")


def test_camodocal(tmp_path):
    """Kannala and Brandt's and Mei's cameras by camodocal's formulas."""
    path = tmp_path / "cam.yaml"
    path.write_text(
        "%YAML:1.0\n---\nmodel_type: KANNALA_BRANDT\ncamera_name: fish\nimage_width: 848\n"
        "image_height: 800\nprojection_parameters:\n   k2: -0.01\n   k3: 0.05\n   k4: -0.04\n"
        "   k5: 0.008\n   mu: 286.2\n   mv: 286.4\n   u0: 421.5\n   v0: 396.6\n"
    )
    (camera,) = read_cameras(path)
    X, Y, Z = 0.7, -0.4, 0.5
    theta, phi = np.arctan2(np.hypot(X, Y), Z), np.arctan2(Y, X)
    r = theta - 0.01 * theta**3 + 0.05 * theta**5 - 0.04 * theta**7 + 0.008 * theta**9
    wanted = [286.2 * r * np.cos(phi) + 421.5, 286.4 * r * np.sin(phi) + 396.6]
    assert camera.id == "fish"
    assert_allclose(image(camera, X, Y, Z), wanted, atol=1e-9)
    path.write_text(
        "%YAML:1.0\n---\nmodel_type: MEI\ncamera_name: camera\nimage_width: 1280\n"
        "image_height: 720\nmirror_parameters:\n   xi: 1.9\ndistortion_parameters:\n   k1: 0.06\n"
        "   k2: 1.0\n   p1: 0.001\n   p2: -0.002\nprojection_parameters:\n   gamma1: 1400.\n"
        "   gamma2: 1410.\n   u0: 640.\n   v0: 358.\n"
    )
    (camera,) = read_cameras(path)
    x, y = np.array([X, Y]) / (Z + 1.9 * np.linalg.norm([X, Y, Z]))
    r2 = x * x + y * y
    radial = 1 + 0.06 * r2 + r2**2
    u = 1400 * (x * radial + 2 * 0.001 * x * y - 0.002 * (r2 + 2 * x * x)) + 640
    v = 1410 * (y * radial - 2 * 0.002 * x * y + 0.001 * (r2 + 2 * y * y)) + 358
    assert camera.id == "cam"
    assert_allclose(image(camera, X, Y, Z), [u, v], atol=1e-9)
    path.write_text(path.read_text().replace("MEI", "POLYFISHEYE"))
    with pytest.raises(InputError, match="model_type is POLYFISHEYE, a camera of camodocal"):
        read_cameras(path)
    path.write_text(path.read_text().replace("POLYFISHEYE", "MEI").replace("   xi: 1.9", ""))
    with pytest.raises(InputError, match="mirror_parameters.xi is missing"):
        read_cameras(path)


def test_orb_slam(tmp_path):
    (camera,) = read_cameras(write_sample(tmp_path, "orb-slam"))
    assert camera.image_size == (752, 480) and camera.parameters["k1"] == -0.28340811
    net = read_network(write_sample(tmp_path, "orb-slam-pair"))
    # x₁ = R·x₂ + t: a point one metre before the second camera
    R, t = pose(net, "Camera2")
    x1 = np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1]]) @ [0, 0, 1.0] + [0.11, 0.02, -0.03]
    assert_allclose(R @ x1 + t, [0, 0, 1], atol=1e-12)
    assert [c.parameters["fx"] for c in net.cameras] == [458.654, 457.587]
    path = tmp_path / "orb.yaml"
    text = path.read_text().replace("PinHole", "KannalaBrandt8").replace("p1", "k3")
    path.write_text(text.replace("p2", "k4"))
    assert {c.model for c in read_network(path).cameras} == {"kannala-brandt"}
    path.write_text(text.replace("KannalaBrandt8", "Spline"))
    with pytest.raises(InputError, match="Camera.type is Spline, of ORB-SLAM"):
        read_network(path)
    path.write_text("settings:\n  Camera.fx: 458.654\n")
    with pytest.raises(InputError, match="Camera.fx is missing at the first level"):
        read_cameras(path)
    # before rectification: other cameras, whose images are not those of Camera.fx
    path = write_sample(tmp_path, "orb-slam")
    raw = "".join(f"{side}.K: {sum(K, [])}\n{side}.D:{D}\n" for side in ("LEFT", "RIGHT"))
    path.write_text(path.read_text() + "Camera.bFishEye: 0\n" + raw)
    (camera,) = read_cameras(path)
    assert camera.parameters["fx"] == 458.654 and "LEFT and RIGHT" in fit_messages([camera])[0]


def test_cameras_in_a_body(tmp_path):
    """VINS-Fusion and EuRoC: from the camera to the body."""
    net = read_network(write_sample(tmp_path, "vins"))
    assert net.images.id == ("cam0", "cam1") and net.cameras[1].parameters["k1"] == -0.29
    assert_allclose(net.images.position, [[0, 0, 0], [0.1, 0, 0]], atol=1e-12)
    assert_allclose(pose(net, "cam1")[0], np.eye(3), atol=1e-12)
    (tmp_path / "right.yaml").unlink()
    with pytest.raises(InputError, match="vins.yaml: cam1_calib: no such file"):
        read_network(tmp_path / "vins.yaml")
    folder = tmp_path / "mav0"
    for k in range(2):
        (folder / f"cam{k}").mkdir(parents=True)
        path = write_sample(folder / f"cam{k}", "euroc")
        path.write_text(path.read_text().replace("[1.0, 0, 0, 0,", f"[1.0, 0, 0, {k * 0.1},"))
    net = read_network(folder)
    assert net.images.id == ("cam0", "cam1") and net.cameras[0].image_size == (752, 480)
    assert_allclose(net.images.position[1], [0.1, 0, 0], atol=1e-12)
    (folder / "cam0").rename(folder / "cam10")
    assert read_network(folder).images.id == ("cam1", "cam10")
    (folder / "cam10").rename(folder / "cam0")
    (camera,) = read_cameras(folder / "cam0" / "sensor.yaml")
    assert camera.id == "cam0" and camera.parameters["p2"] == 1.76187114e-05


def test_visualsfm(tmp_path):
    """Its own formula: the undistorted measurement is the projection."""
    path = tmp_path / "model.nvm"
    path.write_text(NVM)
    net = read_network(path)
    assert net.images.id == ("a b.jpg", "c.jpg") and net.points.id == ("0",)
    assert net.observations.sigma_origin == "unit"  # the file states no σ
    assert_allclose(net.points.position[0], [0.75, 0.5, 0.125])
    for i, (f, r, m) in enumerate([(1000, -0.02, [60, -61]), (1100, 0.03, [55.5, 66.5])]):
        own = net.cameras[net.images.camera[i]]
        p, pixel = all_parameters(own), own.pixel_size[0]
        x, y = net.observations.xy[i]
        assert_allclose([x / pixel, -y / pixel], m, atol=1e-9)
        corrected = np.array([x, -y]) * (1 + p["K1"] * (x * x + y * y)) / p["c"]
        m = np.array(m) / f
        assert_allclose(corrected, m * (1 + r * m @ m), atol=1e-12)
    R, t = pose(net, "c.jpg")
    assert_allclose(R, np.diag([1, -1, -1]), atol=1e-12)  # half a turn about x: q = (0, 1, 0, 0)
    assert_allclose(-R.T @ t, [1, 0, 5], atol=1e-12)
    for old, new, message in [
        ("NVM_V3", "NVM_V3_R9T", "expected NVM_V3"), ("2 0 7", "3 0 7", "line 7: 3 rays"),
        ("NVM_V3", "NVM_V3 FixedK 1000 500 1000 400", "line 1: FixedK"),
        ("-0.02 0", "-0.02 0.1", "line 4: the last number of a camera is 0.1"),
        ("1 9 55", "4 9 55", "image 4 does not exist"),
        ("1000 1 0", "-1000 1 0", "line 4: f is -1000"), ("\n2\n", "\n0\n", "no model"),
        ("\n1\n", "\n2\n", "line 9: the number of rays"), ("0.75", "x", "line 7: "),
    ]:  # fmt: skip
        assert old in NVM
        path.write_text(NVM.replace(old, new, 1))
        with pytest.raises(InputError, match=message):
            read_network(path)


def scene(**changes):
    document = json.loads(ALICEVISION.replace('"@": 0, ', "").replace(', "@": 0', ""))
    document["intrinsics"][0] |= {k: v for k, v in changes.items() if k not in document}
    return document | {k: v for k, v in changes.items() if k in document}


def test_alicevision(tmp_path):
    path = tmp_path / "scene.sfm"
    path.write_text(json.dumps(scene()))
    net = read_network(path)
    (camera,) = net.cameras
    X = np.array([0.2, -0.1, 1.0])
    r2 = 0.05
    radial = 1 - 0.05 * r2 + 0.02 * r2**2 + 0.001 * r2**3
    fx, fy = 6.4 / 8 * 4000, 6.4 / 8 * 4000 * 1.01
    wanted = [fx * 0.2 * radial + 2012.5, -fy * 0.1 * radial + 1493]
    assert_allclose(image(camera, *X), wanted, atol=1e-9)
    R, t = pose(net, "b.jpg")
    # by columns
    assert_allclose(R, np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1.0]]).T, atol=1e-12)
    assert_allclose(net.images.position, [[1, 2, 3]], atol=1e-12)
    assert_allclose(net.observations.xy, [[2100, 1400]])
    other = scene()
    other["views"].append(other["views"][-1] | {"viewId": "99", "intrinsicId": "98"})
    path.write_text(json.dumps(other))
    assert any("1 view whose intrinsicId is not among" in w for w in read_network(path).warnings)
    old = scene(version=["1", "2", "0"], pxFocalLength=["3200", "3210"],
                principalPoint=["2012.5", "1493"])  # fmt: skip
    path.write_text(json.dumps(old))
    p = read_network(path).cameras[0].parameters
    assert [p[k] for k in ("fx", "fy", "cx", "cy")] == [3200, 3210, 2012.5, 1493]
    for document, message in [
        (scene(type="3deanamorphic4"), "a camera of AliceVision of type 3deanamorphic4"),
        (scene(distortionParams=["1", "2", "3", "4"]), "4 distortionParams for radial3"),
        (scene(focalLength="x"), "focalLength is 'x'"), (scene(version=["a"]), "version"),
        (scene(poses=[], structure=[]), "AliceVision without poses and image points"),
        (scene(undistortionParams=["1"], distortionParams=[]), "undistortionParams without"),
    ]:  # fmt: skip
        path.write_text(json.dumps(document))
        with pytest.raises(InputError, match=message):
            read_network(path)


def test_models_of_old_opensfm(tmp_path):
    """Of 2015: no projection_type, which was perspective, and priors beside the parameters."""
    from test_opensfm import files

    scenes, tracks = files("perspective")
    new = max(scenes, key=lambda scene: len(scene["shots"]))
    (camera,) = new["cameras"].values()
    old = {k: v for k, v in camera.items() if k != "projection_type"}
    old |= {"focal_prior": 0.85, "k1_prior": 0.0, "k2_prior": 0.0, "exif_focal": 0.85}
    old = {k: v for k, v in old.items() if not k.startswith("exif")}
    folder = tmp_path / "old"
    folder.mkdir()
    for name, scene in (("new", new), ("old", new | {"cameras": {"v2 cam 1.5": old}})):
        (tmp_path / name).mkdir(exist_ok=True)
        (tmp_path / name / "reconstruction.json").write_text(json.dumps([scene]))
        (tmp_path / name / "tracks.csv").write_text(tracks)
    nets = [read_network(tmp_path / name / "reconstruction.json") for name in ("new", "old")]
    assert nets[0].cameras == nets[1].cameras and len(nets[1].observations) > 30
    (tmp_path / "camera_models.json").write_text(json.dumps({"v2 cam 1.5": old}))
    assert read_cameras(tmp_path / "camera_models.json") == nets[1].cameras


SMALL = Path(__file__).parents[3] / "shared" / "data" / "real" / "small"


@pytest.mark.skipif(not SMALL.is_dir(), reason="the folder ../shared/data/real/small is not here")
@pytest.mark.parametrize("name, size, expected", [
    ("metashape_calibration_xml/calibration.xml", (6000, 4000),
     dict(fx=6600, fy=6600, cx=3010, cy=1945.5, k1=-0.09, k2=0.08, p1=-0.0009, p2=0.0002)),
    ("micmac_bare_root/AutoCal_Foc-3500_Cam-X.xml", (3008, 2000),
     dict(fx=6690.5, fy=6690.5, cx=1504.5, cy=998.75, k1=-0.067144, k2=0.190348)),
    ("opencv_xml/out_camera_data.xml", (640, 480),
     dict(fx=657.3, fy=657.3, cx=319.5, cy=239.5, k1=-0.4183, k2=0.5095, p1=0, p2=0, k3=-0.5784)),
    ("ros_camera_info/echo1_roi.yaml", (200, 150),
     dict(fx=250, fy=250.5, cx=110.25, cy=95.625, k1=-0.3, k2=0.1, p1=0.001, p2=-0.0005)),
    ("ros_camera_info/ost.ini", (640, 480),
     dict(fx=500, fy=501, cx=320.5, cy=241.25, k1=-0.3, k2=0.1, p1=0.001, p2=-0.0005)),
])  # fmt: skip
def test_small_inputs_of_others(name, size, expected):
    (camera,) = read_cameras(SMALL / name)
    assert camera.image_size == size and camera.model == "opencv"
    found = {name: camera.parameters[name] for name in expected}
    assert found == pytest.approx(expected, rel=1e-4, abs=1e-12)


@pytest.mark.skipif(not SMALL.is_dir(), reason="the folder ../shared/data/real/small is not here")
def test_an_angle_and_a_size(command, tmp_path):
    file = SMALL / "transforms_angle_only" / "transforms_train.json"
    with pytest.raises(InputError, match="--image-size W,H"):
        read_network(file)
    (camera,) = read_network(file, image_size=(800, 800)).cameras
    p = camera.parameters
    assert [p["fx"], p["fy"]] == pytest.approx([400 / np.tan(0.6911112070083618 / 2)] * 2)
    assert (p["cx"], p["cy"]) == (399.5, 399.5)
    told = command("convert", file, tmp_path / "out.csv", "--image-size", "800,800")
    assert told.status == 0 and (tmp_path / "out.csv").is_file()
    assert command("camera", file, "--image-size", "800,800").status == 0


def test_xml_under_the_name_of_yaml(tmp_path):
    """OpenCV recognises its files by their content, whatever their names."""
    path = write_sample(tmp_path, "opencv-xml")
    path = path.rename(tmp_path / "camera.yaml")
    (camera,) = read_cameras(path)
    assert camera.model == "opencv" and camera.parameters["fx"] == 657.3


def test_alicevision_writes_empty_lists_as_texts(tmp_path):
    """The property tree of Boost, by which AliceVision writes, has no empty list."""
    path = write_sample(tmp_path, "alicevision")
    document = json.loads(path.read_text())
    for key in ("poses", "structure"):
        (tmp_path / f"{key}.sfm").write_text(json.dumps(document | {key: ""}))
    for point in document["structure"]:
        point["observations"] = ""
    document["views"][0]["path"] = ""
    path.write_text(json.dumps(document))
    net = read_network(path)
    assert len(net.observations) == 0 and net.images.id[0] == document["views"][0]["viewId"]
    assert np.isnan(read_network(tmp_path / "poses.sfm").images.position).all()
    assert len(read_network(tmp_path / "structure.sfm").points) == 0


def test_settings_of_vins_that_do_not_concern_its_cameras(tmp_path):
    path = write_sample(tmp_path, "vins")
    path.write_text(path.read_text() + "publish_rectify: 0\nis_fisheye: 1\n")
    assert not read_network(path).warnings


def test_orb_slam_names_its_setup_as_type(tmp_path):
    path = write_sample(tmp_path, "orb-slam-pair")
    text = path.read_text()
    line = next(line for line in text.splitlines() if line.startswith("Camera.type"))
    path.write_text(text.replace(line, 'Camera.type: "Stereo"\nCamera.model: "Pinhole"'))
    assert [camera.model for camera in read_network(path).cameras] == ["opencv", "opencv"]


PAL = """%YAML:1.0
---
model_type: scaramuzza
camera_name: pal
image_width: 1280
image_height: 720
poly_parameters:
   p0: -246.0
   p1: 0.0
   p2: 2.0e-03
   p3: -3.0e-06
   p4: 6.0e-09
inv_poly_parameters:
   p0: 378.0
   p1: 248.0
affine_parameters:
   ac: 0.999
   ad: 0.001
   ae: -0.002
   cx: 641.5
   cy: 355.25
"""


def test_scaramuzza_of_camodocal(tmp_path):
    """The ray of a pixel: x = A⁻¹·(p − c), (x, y, −Σ pᵢ·ρⁱ), forward +z."""
    path = tmp_path / "pal.yaml"
    path.write_text(PAL)
    (camera,) = read_cameras(path)
    assert (camera.id, camera.model, camera.image_size) == ("pal", "scaramuzza", (1280, 720))
    A = np.array([[0.999, 0.001], [-0.002, 1.0]])
    uv = np.array([[641.5, 355.25], [700.0, 300.0], [400.0, 500.0], [900.0, 100.0]])
    x = (uv - [641.5, 355.25]) @ np.linalg.inv(A).T
    rho = np.hypot(*x.T)
    z = -(-246.0 + 2e-3 * rho**2 - 3e-6 * rho**3 + 6e-9 * rho**4)
    model = get_model("scaramuzza")
    found = images_of(model, all_parameters(camera), np.stack([x[:, 0], -x[:, 1], -z], 1))
    np.testing.assert_allclose(found, uv, atol=1e-8)
    path.write_text(PAL.replace("p1: 0.0", "p1: 0.5", 1))
    with pytest.raises(InputError, match="pal.yaml: poly_parameters.p1 is 0.5"):
        read_cameras(path)
    path.write_text(PAL.replace("scaramuzza", "POLYFISHEYE"))
    with pytest.raises(InputError, match="model_type is POLYFISHEYE, a camera of camodocal"):
        read_cameras(path)


@pytest.mark.parametrize("centres", [[(320.5, 240.25)] * 3, [(320, 240), (960, 640), (320, 240)]])
def test_image_points_of_an_nvm_from_a_corner(tmp_path, centres):
    """COLMAP and others write them so; without a negative coordinate they count from a corner."""
    rng = np.random.default_rng(2)
    X = rng.uniform([-0.9, -0.7, 4], [0.9, 0.7, 6], (40, 3))
    text = {True: "NVM_V3\n\n3\n", False: "NVM_V3\n\n3\n"}
    shift = np.array([[0, 0, 0], [0.3, 0, 0], [0, 0.2, 0.1]])
    for k in range(3):
        for corner in text:
            text[corner] += f"{k}.jpg 1000 1 0 0 0 {' '.join(map(str, shift[k]))} 0 0\n"
    uv = 1000 * np.array([(X - t)[:, :2] / (X - t)[:, 2:] for t in shift])
    for corner in text:
        text[corner] += f"{len(X)}\n"
        for p, at in enumerate(X.tolist()):
            views = " ".join(
                f"{k} {p} {x!r} {y!r}"
                for k, (x, y) in enumerate((uv[:, p] + corner * np.array(centres)).tolist())
            )
            text[corner] += f"{' '.join(map(repr, at))} 1 2 3 3 {views}\n"
    nets = {}
    for corner in text:
        (tmp_path / "m.nvm").write_text(text[corner])
        nets[corner] = read_network(tmp_path / "m.nvm")
    assert_allclose(nets[True].observations.xy, nets[False].observations.xy, atol=1e-12)
    assert not nets[False].warnings
    told = f"({np.median(centres, axis=0)[0]:.2f}, {np.median(centres, axis=0)[1]:.2f}) px"
    assert "counted from a corner" in nets[True].warnings[0] and told in nets[True].warnings[0]


@pytest.mark.parametrize("name, text, kind", [
    ("default.xml", '<?xml version="1.0"?>\n<opencv_storage><Settings><BoardSize_Width>9'
     "</BoardSize_Width></Settings></opencv_storage>\n", "a FileStorage of OpenCV without camera_"),
    ("ground_control_points.json", '{"points": []}', "ground control of OpenSfM; give its folder"),
    ("cameras.xml", "version https://git-lfs.github.com/spec/v1\noid sha256:6a\nsize 361\n",
     "a pointer of Git LFS"),
    ("sensor.yaml", "sensor_type: imu\ncomment: VI-Sensor IMU\n", "another sensor than a camera"),
    ("DIM.XML", '<?xml version="1.0"?>\n<Dimap_Document>\n</Dimap_Document>\n', "DIMAP, a product"),
    ("image.XML", "<isd><IMD/></isd>\n", "support data of DigitalGlobe, a product of a line"),
])  # fmt: skip
def test_a_refusal_names_the_kind_and_what_is_missing(tmp_path, command, name, text, kind):
    path = tmp_path / name
    path.write_text(text)
    for words in (("convert", path, tmp_path / "n.csv"), ("camera", path), ("adjust", path)):
        told = command(*words)
        assert told.status == 2 and kind in told.err and name in told.err


@pytest.mark.parametrize("old, new, message", [
    ('"sensorWidth": "8"', '"sensorWidth": "0"', "sensorWidth is 0, pixelRatio 1.01"),
    ('"pixelRatio": "1.01"', '"pixelRatio": "-1"', "sensorWidth is 8, pixelRatio -1"),
])  # fmt: skip
def test_sensors_of_alicevision_without_size(tmp_path, old, new, message):
    path = write_sample(tmp_path, "alicevision")
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new))
    with pytest.raises(InputError, match=message):
        read_network(path)


def test_a_setting_of_vins_without_cameras(tmp_path):
    path = write_sample(tmp_path, "vins")
    path.write_text(path.read_text().replace("num_of_cam: 2", "num_of_cam: 0"))
    with pytest.raises(InputError, match="num_of_cam is 0; expected a whole number from 1"):
        read_network(path)
    path.write_text('a:\n  cam0_calib: "left.yaml"\n')
    with pytest.raises(InputError, match="cam0_calib is missing at the first level"):
        read_network(path, format="vins")


def test_other_names_of_focal_lengths(tmp_path):
    """fx, fy of every frame, and a scale of depths, as dense_depth_priors_nerf writes them."""
    frame = {"file_path": "a.png", "fx": 700.5, "fy": 701.5, "cx": 320, "cy": 240,
             "transform_matrix": np.eye(4).tolist(), "depth_file_path": "d.png"}  # fmt: skip
    path = tmp_path / "transforms_train.json"
    head = {"near": 0.1, "far": 8.0, "depth_scaling_factor": 1000.0}
    path.write_text(json.dumps({**head, "frames": [frame]}))
    (camera,) = read_network(path).cameras
    core = [camera.parameters[name] for name in ("fx", "fy", "cx", "cy")]
    assert core == [700.5, 701.5, 319.5, 239.5]
    path.write_text(json.dumps({**head, "frames": [{**frame, "fl_x": 700}]}))
    with pytest.raises(InputError, match="fl_x and fx differ"):
        read_network(path)


def test_a_transposed_camera_matrix(tmp_path):
    """Open3D writes it column by column; MATLAB's counts from 1; and the lens model of calibdb."""
    path = tmp_path / "camera.json"
    rows = [[525, 0, 0], [0, 526, 0], [319.5, 239.5, 1]]
    named = {"width": 640, "height": 480, "intrinsic_matrix": [x for row in rows for x in row]}
    path.write_text(json.dumps(named))
    (camera,) = read_cameras(path)
    core = [camera.parameters[name] for name in ("fx", "fy", "cx", "cy")]
    assert core == [525, 526, 319.5, 239.5]
    path.write_text(json.dumps({**named, "intrinsic_matrix": rows}))
    with pytest.raises(InputError, match="transposed, as MATLAB has it, whose pixels count from 1"):
        read_cameras(path)
    rows = {"camera_matrix": [[600, 0, 320], [0, 601, 240], [0, 0, 1]], "img_size": [640, 480],
            "distortion_coefficients": [[0.1, 0.2, 0.001, 0.002, 0.0]],
            "distortion_model": "rectilinear"}  # fmt: skip
    path.write_text(json.dumps(rows))
    (camera,) = read_cameras(path)
    assert camera.model == "opencv" and camera.parameters["k1"] == 0.1


def test_an_angle_of_the_height(tmp_path):
    """camera_angle_y alone: f = h/2 / tan(y/2), square pixels, and the middle of the image."""
    path = write_sample(tmp_path, "transforms")
    path.write_text(path.read_text().replace("camera_angle_x", "camera_angle_y"))
    (camera,) = read_network(path).cameras
    f = 600 / 2 / np.tan(0.7 / 2)
    assert camera.parameters["fx"] == camera.parameters["fy"] == pytest.approx(f, rel=1e-15)
    assert (camera.parameters["cx"], camera.parameters["cy"]) == (399.5, 299.5)
    assert camera.tie == (("fx", "fy"),)
    text = path.read_text()
    path.write_text(text.replace('"camera_angle_y": 0.7, "w": 800, "h": 600', '"fl_x": 500'))
    with pytest.raises(InputError, match="cx is missing, and w and h"):
        read_network(path)
    path.write_text(text.replace('"camera_angle_y": 0.7, ', ""))
    with pytest.raises(InputError, match="fl_x and camera_angle_x are missing"):
        read_network(path)


@pytest.mark.parametrize("model", ["plumb_bob", '""', "none"])
def test_a_camera_of_ros_without_distortion(tmp_path, model):
    """1 × 0 coefficients, as simulated and uncalibrated cameras have."""
    path = write_sample(tmp_path, "ros")
    text = path.read_text().replace("plumb_bob", model)
    old = "{rows: 1, cols: 5, data: [-0.3, 0.1, 0.001, -0.0005, 0]}"
    assert old in text
    path.write_text(text.replace(old, "{rows: 1, cols: 0, data: []}"))
    (camera,) = read_cameras(path)
    assert (camera.model, camera.parameters["fx"]) == ("opencv", 500)
    assert not any(camera.parameters[name] for name in ("k1", "k2", "p1", "p2"))
