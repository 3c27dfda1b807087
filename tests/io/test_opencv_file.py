"""OpenCV's camera files: what we write cv2 reads, what cv2 writes we read."""

import json
import re

import cv2
import numpy as np
import pytest
from numpy.testing import assert_array_equal

from jaxbundle.cameras import get_model
from jaxbundle.cameras.convert_fit import images_of
from jaxbundle.errors import InputError
from jaxbundle.io.cameras.opencv_file import is_opencv, read_opencv
from jaxbundle.io.cameras.opencv_writing import write_opencv
from jaxbundle.io.networks.assemble import all_parameters
from jaxbundle.network import Camera

VALUES = dict(fx=535.9, fy=536.2, cx=342.3, cy=235.6, k1=-0.2663, k2=-0.0386, p1=0.0018,
              p2=-0.0003, k3=0.2386, k4=0.01, k5=-0.02, k6=0.03, s1=1e-3, s2=-2e-3, s3=-1e-3,
              s4=5e-4)  # fmt: skip
ORDER = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6", "s1", "s2", "s3", "s4")
FISHEYE = dict(fx=380.0, fy=381.0, cx=642.0, cy=478.0, k1=0.1, k2=0.05, k3=-0.03, k4=0.006)


@pytest.mark.parametrize("suffix", [".yaml", ".yml", ".json"])
@pytest.mark.parametrize("count", [4, 5, 8, 12])
def test_cv2_reads_what_is_written_and_so_do_we(tmp_path, suffix, count):
    values = VALUES | dict.fromkeys(ORDER[count:], 0.0)
    path = tmp_path / f"cam{suffix}"
    write_opencv(Camera("cam", "opencv", values, image_size=(640, 480)), path)
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_READ)
    K = storage.getNode("camera_matrix").mat()
    assert_array_equal(K, [[535.9, 0, 342.3], [0, 536.2, 235.6], [0, 0, 1]])
    coefficients = storage.getNode("distortion_coefficients").mat().ravel()
    assert_array_equal(coefficients, [VALUES[name] for name in ORDER[:count]])
    assert storage.getNode("image_width").real() == 640
    storage.release()
    back = read_opencv(path)
    assert is_opencv(path)
    assert (back.id, back.model, back.image_size) == ("cam", "opencv", (640, 480))
    assert {k: v for k, v in back.parameters.items() if v} == {k: v for k, v in values.items() if v}


@pytest.mark.parametrize("suffix", [".yaml", ".json"])
@pytest.mark.parametrize("shape", [(1, 5), (5, 1), (14, 1)])
def test_we_read_what_cv2_writes(tmp_path, suffix, shape):
    path = tmp_path / f"theirs{suffix}"
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    storage.write("calibration_time", "Sat 21 Nov")
    storage.write("image_width", 1920)
    storage.write("image_height", 1080)
    storage.write("camera_matrix", np.array([[1e3, 0, 960.1], [0, 1001.5, 540.0], [0, 0, 1]]))
    values = np.zeros(14)
    values[:5] = [-0.1, 0.02, 1e-4, -2e-4, 0.003]
    storage.write("distortion_coefficients", values[: max(shape)].reshape(shape))
    storage.write("extrinsic_parameters", np.arange(60.0).reshape(10, 6))
    storage.release()
    camera = read_opencv(path)
    assert camera.image_size == (1920, 1080)
    assert camera.parameters["fy"] == 1001.5 and camera.parameters["cx"] == 960.1
    assert [camera.parameters[n] for n in ORDER[:5]] == values[:5].tolist()


def test_fisheye_and_the_files_of_ros(tmp_path):
    path = tmp_path / "fisheye.yaml"
    write_opencv(Camera("f", "kannala-brandt", FISHEYE, image_size=(1280, 960)), path)
    back = read_opencv(path)
    assert back.model == "kannala-brandt" and back.parameters == FISHEYE
    ros = tmp_path / "ros.yaml"
    ros.write_text(
        "image_width: 640\nimage_height: 480\ncamera_name: left\ncamera_matrix:\n  rows: 3\n"
        "  cols: 3\n  data: [500.0, 0, 320,\n    0, 501.0, 240, 0, 0, 1]\n"
        "distortion_model: plumb_bob\ndistortion_coefficients:\n  rows: 1\n  cols: 5\n"
        "  data: [0.1, -0.2, 0.001, 0.002, 0]\nprojection_matrix:\n  rows: 3\n  cols: 4\n"
        "  data: [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0]\n"
    )
    camera = read_opencv(ros)
    assert camera.model == "opencv" and camera.parameters["fy"] == 501.0
    assert camera.parameters["p2"] == 0.002


@pytest.mark.parametrize("listed", [True, False])
@pytest.mark.parametrize("names", ["kdrp", "KDRP"])
def test_messages_of_ros(tmp_path, names, listed):
    """CameraInfo as `ros2 topic echo` prints it, lists in lines or in brackets."""
    K, d = [500.0, 0.0, 320.5, 0.0, 501.0, 240.0, 0.0, 0.0, 1.0], [0.1, -0.2, 0.001, 0.002, 0.0]
    shown = lambda x: "\n" + "".join(f"- {v}\n" for v in x) if listed else f" {x}\n"
    values = zip(names, (K, d, np.eye(3).ravel().tolist(), [*K, 0.0, 0.0, 0.0]))
    path = tmp_path / "info.yaml"
    path.write_text(
        "header:\n  stamp: {sec: 17, nanosec: 3}\n  frame_id: left\nheight: 480\nwidth: 640\n"
        "distortion_model: plumb_bob\n" + "".join(f"{k}:{shown(x)}" for k, x in values)
        + "binning_x: 0\nroi:\n  x_offset: 0\n  do_rectify: false\n---\n"
    )
    assert is_opencv(path)
    camera = read_opencv(path)
    assert camera.image_size == (640, 480) and camera.model == "opencv"
    assert [camera.parameters[n] for n in ("fx", "fy", "cx", "cy")] == [500, 501, 320.5, 240]
    assert [camera.parameters[n] for n in ORDER[:5]] == d


GOOD = {
    "image_width": 640, "image_height": 480,
    "camera_matrix": {"rows": 3, "cols": 3, "dt": "d", "data": [5e2, 0, 320, 0, 5e2, 240, 0, 0, 1]},
    "distortion_coefficients": {"rows": 5, "cols": 1, "dt": "d", "data": [0.1, 0, 0, 0, 0]},
}  # fmt: skip


def _with(**changes):
    return {key: value for key, value in {**GOOD, **changes}.items() if value is not None}


def _matrix(rows, columns, data):
    return {"rows": rows, "cols": columns, "dt": "d", "data": data}


def test_coefficients_that_are_0_do_not_count(tmp_path):
    path = tmp_path / "cam.json"
    for n, model in ((5, "fisheye"), (6, "plumb_bob"), (14, "rational"), (3, "plumb_bob")):
        values = [0.1 if k == 0 and n > 4 else 0 for k in range(n)]
        path.write_text(json.dumps(_with(distortion_coefficients=_matrix(n, 1, values),
                                         distortion_model=model)))  # fmt: skip
        camera = read_opencv(path)
        assert camera.parameters["k1"] == values[0] * (n > 4)
        assert camera.model == ("kannala-brandt" if model == "fisheye" else "opencv")


@pytest.mark.parametrize("skew, tilt", [(0.4, (0.0, 0.0)), (0.0, (0.01, -0.02))])
def test_a_skew_and_a_tilt_are_fitted_and_the_difference_told(tmp_path, skew, tilt):
    """Against cv2's own projection, to which the skew adds skew·y''."""
    d = np.array([-0.1, 0.02, 1e-4, -2e-4, 0.003, 0, 0, 0, 0, 0, 0, 0, *tilt])
    path = tmp_path / "cam.json"
    path.write_text(json.dumps(_with(
        camera_matrix=_matrix(3, 3, [500, skew, 320, 0, 505, 240, 0, 0, 1]),
        distortion_coefficients=_matrix(14, 1, d.tolist()),
    )))  # fmt: skip
    camera = read_opencv(path)
    X = np.stack([g.ravel() for g in np.meshgrid(np.linspace(-0.7, 0.7, 40),
                                                 np.linspace(-0.5, 0.5, 40), 1.0)], 1)  # fmt: skip
    K = np.array([[500, 0, 320], [0, 505, 240], [0, 0, 1.0]])
    uv = cv2.projectPoints(X, np.zeros(3), np.zeros(3), K, d)[0][:, 0]
    uv[:, 0] += skew * (uv[:, 1] - 240) / 505
    inside = ((uv > -0.5) & (uv < [639.5, 479.5])).all(1)
    assert np.ptp(uv[inside], axis=0).min() > 450
    off = images_of(get_model(camera.model), all_parameters(camera), X[inside] * [1, -1, -1])
    off = np.linalg.norm(off - uv[inside], axis=1).max()
    told = float(re.search(r"largest difference (\S+) px", camera.message)[1])
    assert off <= 1.05 * told <= 0.5 and ("skew 0.4" in camera.message) == (skew > 0)


BROKEN = {
    "no matrix": (_with(camera_matrix=None), "camera_matrix is missing"),
    "skew": (_with(camera_matrix=_matrix(3, 3, [5, 0.1, 3, 0, 5, 2, 0, 0, 1]), image_width=None,
                   image_height=None), "skew or a tilted sensor; .* image size is needed"),
    "not a camera": (_with(camera_matrix=_matrix(3, 3, [5, 0, 3, 0, 5, 2, 0, 0, 2])), r"\[2\]"),
    "too few": (_with(camera_matrix=_matrix(3, 3, [5, 0, 3])), "3 numbers for 3 rows"),
    "wrong shape": (_with(camera_matrix=_matrix(1, 9, [5, 0, 3, 0, 5, 2, 0, 0, 1])), "3 rows"),
    "claims": (_with(camera_matrix=_matrix(10**18, 3, [1.0])), "1 numbers for"),
    "NaN": (_with(camera_matrix=_matrix(3, 3, [5, 0, 3, 0, 5, float("nan"), 0, 0, 1])), "finite"),
    "text": (_with(camera_matrix=_matrix(3, 3, ["5"] * 9)), "finite numbers"),
    "focal": (_with(camera_matrix=_matrix(3, 3, [0, 0, 3, 0, 5, 2, 0, 0, 1])), "fx must be posi"),
    "coefficients": (_with(distortion_coefficients=_matrix(6, 1, [0.1] * 6)), "has 6 values"),
    "size": (_with(image_width=640.5), "image size"),
    "fisheye": (_with(distortion_model="fisheye",
                      distortion_coefficients=_matrix(5, 1, [0.1] * 5)), "a fisheye has 4"),
    "list": ([1, 2], "an object"),
    "huge": (_with(camera_matrix=_matrix(3, 3, [10**400] * 9)), "finite numbers"),
}


@pytest.mark.parametrize("name", BROKEN)
def test_broken_files_are_refused(tmp_path, name):
    document, message = BROKEN[name]
    path = tmp_path / "camera.json"
    path.write_text(json.dumps(document))
    with pytest.raises(InputError, match=message) as caught:
        read_opencv(path)
    assert "camera.json" in str(caught.value)


@pytest.mark.parametrize(
    "text, message",
    [
        ("", "the file is empty"),
        ("name: x", "camera_matrix is missing"),
        ("camera_matrix: !!opencv-matrix\n   rows: 3\n   data: [ 1, 2", "line 4: not valid"),
        ("camera_matrix: 5\ncamera_matrix: 6\n", "twice"),
        ("camera_matrix: 5\n", "list of finite numbers"),
        ("{" * 100_000, "JSON"),
        ('{"a":' * 100_000, "JSON"),
    ],
)
def test_broken_yaml_is_refused(tmp_path, text, message):
    path = tmp_path / "camera.yaml"
    path.write_text(text)
    with pytest.raises(InputError, match=message):
        read_opencv(path)


def test_other_models_are_refused_by_name(tmp_path):
    with pytest.raises(InputError, match="OpenCV has no model 'brown'.*--model opencv"):
        write_opencv(Camera("c", "brown", {"c": 24.0}), tmp_path / "c.yaml")
    assert not list(tmp_path.iterdir())
