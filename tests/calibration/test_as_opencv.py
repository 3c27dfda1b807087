"""`calibrate_opencv` beside `cv2.calibrateCamera`: the same arguments, the same return values."""

import cv2
import numpy as np
import pytest

import jaxbundle
from jaxbundle.errors import InputError, NotSolvedError

SIZE = (1280, 960)
K = np.array([[1000.0, 0, 650], [0, 1010, 470], [0, 0, 1]])
D = np.array([-0.2, 0.08, 0.001, -0.0005, 0.02])


def views(noise=0.05, seed=0, partly=True):
    """Twelve views of a board, in some of which a part of it was found."""
    rng = np.random.default_rng(seed)
    board = np.zeros((48, 3), np.float32)
    board[:, :2] = 0.03 * np.mgrid[:8, :6].reshape(2, -1).T
    objects, images = [], []
    for k in range(12):
        r = np.array([0.5 * np.sin(k), 0.5 * np.cos(1.7 * k), 0.4 * k])
        R = cv2.Rodrigues(r)[0]
        t = np.array([0.02 * np.cos(k), 0.02 * np.sin(k), 0.45 + 0.02 * k]) - R @ [0.105, 0.075, 0]
        x, _ = cv2.projectPoints(board, r, t, K, D)
        some = np.arange(48) if not partly or k % 3 else np.arange(0, 48 - 5, 1)
        objects.append(board[some])
        images.append((x[some] + noise * rng.normal(size=(len(some), 1, 2))).astype(np.float32))
    return objects, images


def test_it_returns_what_opencv_returns():
    objects, images = views()
    stop = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 300, 1e-15)
    theirs = cv2.calibrateCamera(objects, images, SIZE, None, None, criteria=stop)
    rms, camera, coefficients, rvecs, tvecs = found = jaxbundle.calibrate_opencv(
        objects, images, SIZE
    )
    assert rms == pytest.approx(theirs[0], abs=1e-6)
    np.testing.assert_allclose(camera, theirs[1], rtol=1e-5)
    assert np.shape(coefficients) == np.shape(theirs[2])
    np.testing.assert_allclose(coefficients, theirs[2], atol=2e-3)
    assert len(rvecs) == len(theirs[3]) and rvecs[0].shape == theirs[3][0].shape
    np.testing.assert_allclose(np.array(tvecs), np.array(theirs[4]), atol=2e-5)
    for ours, other in zip(rvecs, theirs[3]):  # a rotation has many vectors
        np.testing.assert_allclose(cv2.Rodrigues(ours)[0], cv2.Rodrigues(other)[0], atol=2e-5)
    # the results project like OpenCV's
    x, _ = cv2.projectPoints(objects[1], rvecs[1], tvecs[1], camera, coefficients)
    assert np.sqrt(np.mean((x - images[1]) ** 2)) < 0.06
    # σ: those of OpenCV's extended function agree in size
    extended = cv2.calibrateCameraExtended(objects, images, SIZE, None, None, criteria=stop)
    std = dict(zip(("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3"), extended[5].ravel()))
    for name, value in found.sigma.items():
        assert value == pytest.approx(std[name], rel=0.02)
    assert found.covariance.shape == (9, 9) and "fx ±" in repr(found)
    assert found.redundancy == 2 * sum(map(len, objects)) - 9 - 6 * 12


def test_free_parameters_and_blunders():
    objects, images = views(partly=False)
    found = jaxbundle.calibrate_opencv(objects, images, SIZE, free=("fx", "fy", "cx", "cy", "k1"))
    assert found.parameters == ("fx", "fy", "cx", "cy", "k1")
    assert found.dist_coeffs.shape == (1, 5) and found.dist_coeffs[0, 1] == 0
    images[2][7] += 30.0
    clean = jaxbundle.calibrate_opencv(objects, images, SIZE, snooping="pope")
    assert clean.rms < 0.1 and clean.result.removed.sum() >= 1
    assert jaxbundle.calibrate_opencv(objects, images, SIZE).rms > 1


def test_arrays_of_other_shapes_are_named():
    objects, images = views(partly=False)
    for X, x, why in (
        ([], [], "0 views"), (objects[:3], images[:2], "3 views of object_points and 2"),
        ([objects[0][:, :2]], images[:1], r"object_points\[0\]: expected an array \[n, 3\]"),
        ([objects[0][:5]], images[:1], "5 object points and 48 image points"),
        ([objects[0][[0, 0, 1, 2, 3, 4]]], [images[0][:6]], "occurs twice"),
    ):  # fmt: skip
        with pytest.raises(InputError, match=why):
            jaxbundle.calibrate_opencv(X, x, SIZE)
    with pytest.raises(NotSolvedError, match="not determined"):
        jaxbundle.calibrate_opencv([objects[0][:3]], [images[0][:3]], SIZE)
