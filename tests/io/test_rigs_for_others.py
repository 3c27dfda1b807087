"""A calibrated rig in the files of Kalibr, mrcal, OpenCV and ROS: points are projected by OpenCV
(`cv2.projectPoints`, an independent implementation) through what is in the files, by the convention
of each format, and meet the pixels of the rig itself; and our readers read the rig back."""

import ast
import dataclasses
import json
import re
from fnmatch import fnmatch
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from jaxbundle.calibration.files import files_of, fill_rig
from jaxbundle.cameras import get_model
from jaxbundle.cameras.convert_fit import images_of, rays_of
from jaxbundle.errors import InputError
from jaxbundle.io.exchange import convert
from jaxbundle.io.formats import read_network
from jaxbundle.io.networks.assemble import all_parameters
from jaxbundle.io.networks.kalibr import write_kalibr
from jaxbundle.io.networks.mrcal import fill_mrcal
from jaxbundle.io.networks.poses import angles_of
from jaxbundle.io.networks.rig_result import network_of_rig
from jaxbundle.io.networks.stereo import fill_ros_stereo, write_opencv_stereo
from jaxbundle.network.tables import Camera

RADTAN = (("k1", -0.28), ("k2", 0.07), ("p1", 3e-4), ("p2", -2e-4))
EQUI = (("k1", -0.01), ("k2", 0.02), ("k3", -0.01), ("k4", 0.002))
K = ({"fx": 460.0, "fy": 458.0, "cx": 367.0, "cy": 248.0},
     {"fx": 471.0, "fy": 472.0, "cx": 380.0, "cy": 255.0})  # fmt: skip
TURNS = Rotation.from_euler(
    "xyz", [[0, 0, 0], [0.02, -0.08, 0.01], [-0.03, 0.1, 0.2], [0.05, 0.3, -0.1]]
).as_matrix()
BASES = {"right": [0.11, 0.004, -0.01], "left": [-0.11, 0.02, 0.01], "below": [0.01, -0.2, 0.02]}
POINTS = np.random.default_rng(1).uniform([-0.6, -0.5, -3], [0.6, 0.5, -1.5], (20, 3))
"""In the frame of the reference, which has y up and looks along −z."""
FLIP = np.array([1.0, -1, -1])


def camera(k, fisheye=False):
    model, own = ("kannala-brandt", EQUI) if fisheye else ("opencv", RADTAN)
    parameters = K[k % 2] | {name: value * (1 + 0.1 * k) for name, value in own}
    return Camera(f"c{k}", model, parameters, image_size=(752, 480))


def rig(base="right", fisheye=False, number=2):
    bases = [[0, 0, 0], BASES[base], [0.0, 0.1, 0.03], [0.3, 0.0, 0.1]]
    bases = [np.array(base, float) for base in bases[:number]]
    cameras = [camera(k, fisheye) for k in range(number)]
    return network_of_rig(Path("rig"), cameras, TURNS[:number], bases, "m"), bases


def seen(X, M, D, fisheye):
    """Pixels of points in a camera's frame with y down and z forward."""
    X, zero = np.ascontiguousarray(X)[:, None], np.zeros(3)
    project = cv2.fisheye.projectPoints if fisheye else cv2.projectPoints
    uv, _ = project(X, zero, zero, np.asarray(M, float), np.asarray(D, float))
    return uv[:, 0]


def truth(k, bases, fisheye=False):
    """X_k = R·(X − b), the definition of a mounting."""
    p = camera(k, fisheye).parameters
    M = np.array([[p["fx"], 0, p["cx"]], [0, p["fy"], p["cy"]], [0, 0, 1]])
    D = np.array([p[name] for name, _ in (EQUI if fisheye else RADTAN)])
    return seen((POINTS - bases[k]) @ TURNS[k].T * FLIP, M, D, fisheye)


def check_back(path, net, cameras=None):
    """The rig, or some of its cameras, as our reader reads it: cameras, and poses relative to the
    reference."""
    rows = list(range(len(net.cameras)) if cameras is None else cameras)
    back = read_network(path)
    assert len(back.cameras) == len(rows)
    for a, b in zip(back.cameras, (net.cameras[k] for k in rows)):
        found, expected = all_parameters(a), all_parameters(b)
        assert a.model == b.model and a.image_size == b.image_size
        assert found == pytest.approx(expected, abs=1e-12)
    order = back.images.camera.argsort()
    assert_allclose(back.images.position[order], net.images.position[rows], atol=1e-12)
    turn = lambda n, at: Rotation.from_euler("xyz", n.images.angles[at])
    apart = (turn(back, order) * turn(net, rows).inv()).magnitude()
    assert apart.max() < 1e-9


@pytest.mark.parametrize("fisheye", [False, True])
def test_kalibr(tmp_path, fisheye):
    net, bases = rig(fisheye=fisheye, number=3)
    path = convert_network(net, tmp_path / "camchain.yaml")
    text, X = path.read_text(), POINTS * FLIP
    for k in range(3):
        part = text.partition(f"cam{k}:")[2].partition(f"cam{k + 1}:")[0]
        numbers = lambda key, part=part: ast.literal_eval(re.search(rf"{key}: (\[.*\])", part)[1])
        rows = re.findall(r"^  - (\[.*\])", part.partition("T_cn_cnm1:")[2], re.M)
        rows = rows or re.findall(r"^\s+- (\[.*\])", part.partition("T_cn_cnm1:")[2], re.M)
        if k:
            T = np.array([ast.literal_eval(row) for row in rows[:4]])
            X = X @ T[:3, :3].T + T[:3, 3]
        fu, fv, pu, pv = numbers("intrinsics")
        uv = seen(X, [[fu, 0, pu], [0, fv, pv], [0, 0, 1]], numbers("distortion_coeffs"), fisheye)
        assert_allclose(uv, truth(k, bases, fisheye), atol=1e-8)
    check_back(path, net)


RIG_WRITERS = {"camchain.yaml": write_kalibr, "mrcal": fill_mrcal, "camera_info": fill_ros_stereo}


@pytest.mark.parametrize("name", RIG_WRITERS)
def test_lengths_leave_in_metres(tmp_path, name):
    """The same rig in millimetres gives the same file; one in a unit nobody knows is written as it
    is, and that is said."""
    net, bases = rig()
    in_metres, in_mm = ((tmp_path / unit / name) for unit in ("m", "mm"))
    for unit, factor, path in (("m", 1, in_metres), ("mm", 1000, in_mm)):
        path.parent.mkdir()
        scaled = network_of_rig(
            Path("rig"), net.cameras, TURNS[:2], [factor * base for base in bases], unit
        )
        losses = RIG_WRITERS[name](scaled, path)
        assert not any("unit" in loss for loss in losses)
        check_back(path, net)
    losses = RIG_WRITERS[name](net.replace(object_unit="model"), tmp_path / name)
    assert sum("expects metres" in loss for loss in losses) == 1
    check_back(tmp_path / name, net)


def test_coefficients_that_kalibr_lacks_are_fitted_and_said(tmp_path):
    """k3 of a mild lens: pixels of the chain are off by what the message says."""
    net, bases = rig()
    mild = {"k1": -0.1, "k2": 0.02, "k3": 0.03}
    cameras = [dataclasses.replace(one, parameters={**one.parameters, **mild})
               for one in net.cameras]  # fmt: skip
    net = net.replace(cameras=tuple(cameras))
    lost = write_kalibr(net, tmp_path / "camchain.yaml")
    said = [line for line in lost if line.startswith("k3 of camera")]
    back = read_network(tmp_path / "camchain.yaml").cameras
    u, v = np.meshgrid(np.linspace(0, 751, 40), np.linspace(0, 479, 30))
    for line, given, found in zip(said, cameras, back, strict=True):
        one, other = (get_model(camera.model) for camera in (given, found))
        rays = rays_of(one, all_parameters(given), np.stack([u, v], -1).reshape(-1, 2))
        off = np.linalg.norm(images_of(other, all_parameters(found), rays)
                             - np.stack([u, v], -1).reshape(-1, 2), axis=1)  # fmt: skip
        largest, rms = (float(re.search(rf"{word} ([\d.]+)", line)[1])
                        for word in ("difference", "RMS"))  # fmt: skip
        assert off.max() == pytest.approx(largest, rel=0.2) and off.max() < 1.0
        assert np.sqrt(np.mean(off**2)) == pytest.approx(rms, rel=0.2)


def convert_network(net, path):
    """As `convert` writes it."""
    from jaxbundle.io.output_formats import TARGETS, recognise_target

    TARGETS[recognise_target(path)].write(net, path)
    return path


def test_mrcal(tmp_path):
    net, bases = rig(number=3)
    folder = convert_network(net, tmp_path / "mrcal")
    for k in range(3):
        model = ast.literal_eval((folder / f"c{k}.cameramodel").read_text())
        rt = np.array(model.get("extrinsics", model.get("rt_cam_ref")))
        X = POINTS * FLIP @ cv2.Rodrigues(rt[:3])[0].T + rt[3:]
        fx, fy, cx, cy, *D = model["intrinsics"]
        uv = seen(X, [[fx, 0, cx], [0, fy, cy], [0, 0, 1]], D, False)
        assert_allclose(uv, truth(k, bases), atol=1e-8)
    check_back(folder, net)


def check_rectified(k, uv, M, D, R, P, R1, fisheye):
    """OpenCV's undistorted and rectified pixels are P·[R₁·X₁; 1]."""
    given = {"R": R, "P": P[:, :3].copy()}
    if fisheye:
        found = cv2.fisheye.undistortPoints(uv[:, None], M, D, **given)[:, 0]
    else:
        # OpenCV 4 has a name of its own for it
        undistort = getattr(cv2, "undistortPointsIter", cv2.undistortPoints)
        until = cv2.TERM_CRITERIA_COUNT, 60, 0
        found = undistort(uv[:, None], M, D, **given, criteria=until)[:, 0]
    X = np.c_[POINTS * FLIP @ R1.T, np.ones(len(POINTS))] @ P.T
    assert_allclose(found, X[:, :2] / X[:, 2:], atol=1e-4)
    return found


@pytest.mark.parametrize("base", BASES)
@pytest.mark.parametrize("fisheye", [False, True])
def test_opencv_stereo(tmp_path, base, fisheye):
    net, bases = rig(base, fisheye)
    path = convert_network(net, tmp_path / "stereo.yaml")
    file = cv2.FileStorage(str(path), cv2.FILE_STORAGE_READ)
    get = lambda name: file.getNode(name).mat()
    assert int(file.getNode("image_width_1").real()) == 752
    X = POINTS * FLIP
    rows = []
    for k, (R, T) in enumerate(((np.eye(3), np.zeros((3, 1))), (get("R"), get("T"))), 1):
        M, D = get(f"M{k}"), get(f"D{k}")
        uv = seen(X @ R.T + T[:, 0], M, D, fisheye)
        assert_allclose(uv, truth(k - 1, bases, fisheye), atol=1e-8)
        rows.append(check_rectified(
            k, uv, M, D, get(f"R{k}"), get(f"P{k}"), get("R1"), fisheye))  # fmt: skip
    along = 1 if base == "below" else 0
    assert_allclose(rows[0][:, 1 - along], rows[1][:, 1 - along], atol=1e-4)
    disparity = rows[0] - rows[1]
    h = np.c_[rows[0], disparity[:, along], np.ones(len(X))] @ get("Q").T
    assert_allclose(h[:, :3] / h[:, 3:], X @ get("R1").T, atol=2e-5)
    # upright: neither camera is turned by more than half of what they are apart
    assert max(np.degrees(Rotation.from_matrix(get(f"R{k}")).magnitude()) for k in (1, 2)) < 20
    check_back(path, net)
    check_back(convert_network(net, tmp_path / "stereo.json"), net)


@pytest.mark.parametrize("base", BASES)
def test_ros_pair(tmp_path, base):
    """As image_geometry's StereoCameraModel takes it: the second's P₁₄ is −fx·B."""
    net, bases = rig(base)
    folder = convert_network(net, tmp_path / "camera_info")
    infos = []
    for k in range(2):
        text = (folder / f"c{k}.yaml").read_text()
        of = lambda key, text=text: np.array(ast.literal_eval(
            re.search(rf"{key}:\s+rows: \d+\s+cols: \d+\s+data: (\[.*?\])", text, re.S)[1]))
        infos.append((of("camera_matrix").reshape(3, 3), of("distortion_coefficients"),
                      of("rectification_matrix").reshape(3, 3),
                      of("projection_matrix").reshape(3, 4)))  # fmt: skip
        assert f'camera_name: "c{k}"' in text and "image_width: 752" in text
    for k, (M, D, R, P) in enumerate(infos):
        check_rectified(k, truth(k, bases), M, D, R, P, infos[0][2], False)
    P = infos[1][3]
    along = 1 if base == "below" else 0
    sign = -1 if base in ("right", "below") else 1
    assert P[along, 3] == pytest.approx(sign * P[0, 0] * np.linalg.norm(bases[1]), rel=1e-12)
    assert P[1 - along, 3] == 0 and not infos[0][3][:, 3].any()
    check_back(folder, net)


def test_what_a_pair_is_not(tmp_path):
    net, _ = rig(number=1)
    with pytest.raises(InputError, match="holds two cameras, got 1"):
        write_opencv_stereo(net, tmp_path / "stereo.yaml")
    with pytest.raises(InputError, match="holds two cameras, got 1"):
        fill_ros_stereo(net, tmp_path / "camera_info")
    net, _ = rig()
    path = convert_network(net, tmp_path / "stereo.yaml")
    text = path.read_text()
    path.write_text(text.replace("\nT:", "\nx:"))
    with pytest.raises(InputError, match="stereo.yaml: R without the other of R and T"):
        read_network(path)
    path.write_text(re.sub(r"(\nR:.*?data: \[ )[^,]+", r"\g<1>7", text, count=1, flags=re.S))
    with pytest.raises(InputError, match="stereo.yaml: R is not a rotation"):
        read_network(path)
    folder = convert_network(net, tmp_path / "camera_info")
    (folder / "c1.yaml").write_text((folder / "c0.yaml").read_text())
    with pytest.raises(InputError, match="got none with"):
        read_network(folder)
    assert not list(tmp_path.glob("*.tmp"))


@pytest.mark.parametrize("name", ["stereo.yaml", "camera_info"])
def test_a_rig_of_four_cameras_leaves_as_pairs(tmp_path, command, name):
    net, _ = rig(number=4)
    source, out = tmp_path / "camchain.yaml", tmp_path / "out"
    convert_network(net, source)
    out.mkdir()
    told = command("convert", source, out / name)
    places = [out / (f"stereo_cam0_cam{k}.yaml" if name == "stereo.yaml"
                     else f"camera_info/cam0_cam{k}") for k in (1, 2, 3)]  # fmt: skip
    assert told.status == 0 and all(str(place) in told.out for place in places), told
    named = net.replace(cameras=tuple(dataclasses.replace(c, id=f"cam{k}")
                                      for k, c in enumerate(net.cameras)))  # fmt: skip
    for k, place in enumerate(places, 1):
        check_back(place, named, (0, k))
        assert {c.id for c in read_network(place).cameras} == {"cam0", f"cam{k}"}
    # written again: nothing is replaced unasked
    places[1].touch()
    told = command("convert", source, out / name)
    assert (told.status, name == "stereo.yaml") in ((2, True), (0, False)), told
    assert command("convert", source, out / name, "--force").status == 0


def test_cameras_that_face_each_other_have_no_rectification(tmp_path):
    """R and T are written for OpenCV; ROS has the mounting in the rectification only."""
    net, _ = rig(number=3)
    angles = net.images.angles.copy()
    angles[2] = angles[0] + (0, np.pi, 0)
    net = net.replace(images=dataclasses.replace(net.images, angles=angles))
    lost = write_opencv_stereo(net, tmp_path / "stereo.yaml")
    assert [line for line in lost if "rectification of 'c0' and 'c2'" in line]
    assert not [line for line in lost if "'c1'" in line]
    for k in (1, 2):
        file = tmp_path / f"stereo_c0_c{k}.yaml"
        assert "nan" not in file.read_text().lower()
        check_back(file, net, (0, k))
    lost = fill_ros_stereo(net, tmp_path / "camera_info")
    assert [line for line in lost if "pair of 'c0' and 'c2'" in line]
    assert [p.name for p in (tmp_path / "camera_info").iterdir()] == ["c0_c1"]


def test_the_folder_of_a_calibrated_rig_has_its_pairs(tmp_path):
    net, _ = rig(number=4)
    fill_rig(net, tmp_path / "rig")
    for k in (1, 2, 3):
        check_back(tmp_path / "rig" / f"stereo_c0_c{k}.yaml", net, (0, k))
        check_back(tmp_path / "rig" / "camera_info" / f"c0_c{k}", net, (0, k))
    said = (tmp_path / "rig" / "conversions.txt").read_text()
    assert "stereo_c0_c3.yaml" in said and "camera_info/c0_c3" in said
    # an output folder may be written again: its files are all known
    files = [p.relative_to(tmp_path).as_posix() for p in tmp_path.rglob("*") if p.is_file()]
    known = files_of([f"c{k}" for k in range(4)])
    assert not [file for file in files if not any(fnmatch(file, name) for name in known)]


RIG = {"reference": "c0", "mountings": {}, "cameras": {}}
RESULT = {"converged": True, "calibrations": {}, "rig": RIG}


def result_json(folder, **changes):
    """The part of `calibrate --rig --json` that is read."""
    document = json.loads(json.dumps(RESULT))
    for k, base in enumerate(([0, 0, 0], BASES["right"])):
        one = camera(k)
        values = {name: {"value": value} for name, value in one.parameters.items()}
        document["calibrations"][one.id] = {
            "calibration": {"image_size": [752, 480]},
            "cameras": {one.id: {"model": "opencv", "parameters": {}}},
        }
        document["rig"]["cameras"][one.id] = values
        if k:
            document["rig"]["mountings"][one.id] = {"base": base, "rotation": TURNS[k].tolist()}
    path = folder / "result.json"
    path.write_text(json.dumps(document | changes))
    return path


@pytest.mark.parametrize("name", ["camchain.yaml", "mrcal", "stereo.yaml", "camera_info"])
def test_the_json_of_a_calibration_is_converted(tmp_path, name):
    done = convert(result_json(tmp_path), tmp_path / name)
    assert list(done.warnings) == []
    check_back(tmp_path / name, rig()[0])


def rig_line(key="cars/7", **changes):
    """The part of a line of `batch --rig` that is read."""
    mountings, cameras, sizes = {}, {}, {}
    for k, base in enumerate(([0.0, 0, 0], BASES["right"])):
        one, angles = camera(k), angles_of(TURNS[k : k + 1])[0]
        names = ("X0", "Y0", "Z0", "omega", "phi", "kappa")
        mountings[f"{one.id} of rig"] = {
            name: {"value": float(x)} for name, x in zip(names, (*base, *angles))
        }
        values = {name: {"value": value} for name, value in one.parameters.items()}
        cameras[one.id], sizes[one.id] = {"model": "opencv", "parameters": values}, [752, 480]
    row = {"key": key, "status": "converged", "settings": {}, "converged": True,
           "cameras": cameras, "image_size": sizes,
           "further_unknowns": {"mounting": mountings}}  # fmt: skip
    return json.dumps(row | changes)


@pytest.mark.parametrize("name", ["camchain.yaml", "mrcal", "stereo.yaml", "camera_info"])
def test_a_rig_of_a_batch_is_converted(tmp_path, name):
    file = tmp_path / "rigs.jsonl"
    camera_alone = json.dumps({"key": "A17", "status": "converged", "parameters": {}})
    file.write_text(rig_line(settings={"pixel_size": 0.004}))  # the only one needs no key
    assert read_network(file).cameras[1].pixel_size == (0.004, 0.004)
    file.write_text("\n".join([camera_alone, rig_line("cars/6"), rig_line("rigs.npz#7")]) + "\n")
    done = convert(f"{file}#rigs.npz#7", tmp_path / name)
    assert [line for line in done.warnings if "image points" in line] == []
    check_back(tmp_path / name, rig()[0])
    for text, words in (
        (f"{file}", "2 rigs; name one.*'cars/6', 'rigs.npz#7'"),
        (f"{file}#cars/5", "no rig 'cars/5'; did you mean 'cars/6'"),
        (f"{tmp_path / 'no.jsonl'}#cars/5", "no.jsonl: no such file"),
    ):  # fmt: skip
        with pytest.raises(InputError, match=words):
            read_network(text)
    for line, words in (
        (camera_alone, "no rig is in it"),
        ("text", "line 1: not a line of jaxbundle batch"),
        (rig_line(converged=False, status="iteration limit"), r"not solved \(iteration limit\)"),
        (rig_line(cameras={}), "cars/7: not a line of jaxbundle batch --rig: has no 'c0'"),
    ):  # fmt: skip
        file.write_text(line + "\n")
        with pytest.raises(InputError, match=words):
            read_network(file)


def test_results_that_are_no_rig(tmp_path):
    for changes, words in (
        ({"rig": None}, "without a mounting"),
        ({"rig": {"reference": "c0", "mountings": {}}}, "has no 'cameras'"),
    ):  # fmt: skip
        with pytest.raises(InputError, match=words):
            read_network(result_json(tmp_path, **changes))
