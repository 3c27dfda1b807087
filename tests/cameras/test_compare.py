"""Difference maps of two calibrations, against scipy and against conversions."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from jaxbundle.cameras import convert_camera, get_model
from jaxbundle.cameras.compare import Comparison, compare_cameras, difference_rings

SIZE = (1280, 720)
A = dict(fx=1000.0, fy=1001.0, cx=640.0, cy=358.0, k1=-0.1, k2=0.02)
OPENCV = get_model("opencv")


def test_a_calibration_is_itself():
    found = compare_cameras((OPENCV, A), (OPENCV, A), image_size=SIZE)
    assert found.largest < 1e-9 and found.covered == 1
    assert_allclose(found.rotation, 0, atol=1e-14)


def test_against_scipy():
    """Another principal distance and point, without distortion: the rotation by scipy."""
    a = dict(fx=1000.0, fy=1000.0, cx=640.0, cy=360.0)
    b = dict(fx=1004.0, fy=1003.0, cx=646.0, cy=357.0)
    found = compare_cameras((OPENCV, a), (OPENCV, b), image_size=SIZE)
    u = np.stack(np.meshgrid(found.x, found.y), -1).reshape(-1, 2)
    rays = np.concatenate([(u - [640, 360]) / 1000, np.ones((len(u), 1))], 1) * [1, -1, -1]

    def difference(theta):
        r, s, q = Rotation.from_rotvec(theta).apply(rays).T
        return np.stack([646 - 1004 * r / q - u[:, 0], 357 + 1003 * s / q - u[:, 1]], 1)

    best = least_squares(lambda t: difference(t).ravel(), np.zeros(3), xtol=1e-15, ftol=1e-15,
                         gtol=1e-15)  # fmt: skip
    assert_allclose(found.rotation, best.x, atol=1e-9)
    assert_allclose(found.difference.reshape(-1, 2), difference(best.x), atol=1e-6)
    plain = compare_cameras((OPENCV, a), (OPENCV, b), image_size=SIZE, rotate=False)
    assert plain.rms == pytest.approx(np.sqrt(np.mean(difference(np.zeros(3)) ** 2) * 2), rel=1e-12)
    # a shift of the principal point of 6 px looks like 6/1000 rad, what is left is second order
    assert plain.rms > 6 and found.rms < 3
    assert abs(found.rotation[1]) == pytest.approx(0.006, rel=0.2)


def test_models_of_different_units():
    brown = get_model("brown")
    made = convert_camera(OPENCV, A, brown, image_size=SIZE, pixel_size=(0.005, 0.005))
    there = compare_cameras(
        (brown, made.parameters), (OPENCV, A), image_size=SIZE, pixel_size=(0.005, 0.005),
        rotate=False,
    )  # fmt: skip
    assert there.unit == "mm"
    assert there.rms == pytest.approx(made.rms, rel=0.05)
    turned = compare_cameras(
        (brown, made.parameters), (OPENCV, A), image_size=SIZE, pixel_size=(0.005, 0.005)
    )
    assert turned.rms <= there.rms * (1 + 1e-9)


def test_where_there_is_no_ray_there_is_no_difference():
    strong = A | dict(k1=-0.45, k2=0.0)
    found = compare_cameras((OPENCV, A), (OPENCV, strong), image_size=SIZE)
    assert np.isfinite(found.difference).all()
    found = compare_cameras((OPENCV, strong), (OPENCV, A), image_size=(1400, 1200))
    assert 0.3 < found.covered < 1
    assert np.isnan(found.length).mean() == pytest.approx(1 - found.covered)


def test_radius_of_the_fit():
    b = A | dict(k1=-0.12, cx=643.0)
    near = compare_cameras((OPENCV, A), (OPENCV, b), image_size=SIZE, radius=200)
    everywhere = compare_cameras((OPENCV, A), (OPENCV, b), image_size=SIZE)
    middle = np.s_[10:15, 14:19]
    assert np.mean(near.length[middle]) < np.mean(everywhere.length[middle])
    with pytest.raises(ValueError, match="too few points"):
        compare_cameras((OPENCV, A), (OPENCV, b), image_size=SIZE, radius=1)


def test_rings():
    x, y = np.linspace(-10, 10, 21), np.linspace(-5, 5, 11)
    grid = np.stack(np.meshgrid(x, y), -1)
    r = np.linalg.norm(grid, axis=2)
    quarter = np.stack([-grid[..., 1], grid[..., 0]], -1)
    difference = 0.01 * grid + 0.002 * quarter
    map = Comparison("mm", x, y, difference, np.zeros(3), 0, 0, (0, 0), 1)
    table = difference_rings(map, 2.0)
    assert_allclose(table["r"], [2, 4, 6, 8, 10, 12])
    for k, outer in enumerate(table["r"]):
        ring = (r >= outer - 2) & (r < outer)
        assert table["points"][k] == ring.sum()
        assert table["radial"][k] == pytest.approx(0.01 * r[ring].mean())
        assert table["tangential"][k] == pytest.approx(0.002 * r[ring].mean())
        assert table["largest"][k] == pytest.approx(np.hypot(0.01, 0.002) * r[ring].max())
    with pytest.raises(ValueError, match="width of rings"):
        difference_rings(map, 0.0)


def test_sizes_that_are_needed():
    with pytest.raises(ValueError, match="image_size is needed"):
        compare_cameras((OPENCV, A), (OPENCV, A))


def test_where_a_polynomial_turns_back_there_is_no_difference():
    """g = r·(1 + k1·r²) turns back at r² = −1/(3·k1): rays beyond have an image of others. A second
    camera whose polynomial turns back inside the image has no values beyond, and as large a
    difference elsewhere as the formula says."""
    a = dict(fx=500.0, fy=500.0, cx=639.5, cy=359.5)
    folds = dict(a, k1=-0.3)
    found = compare_cameras((OPENCV, a), (OPENCV, folds), image_size=SIZE, rotate=False)
    r = np.hypot(*np.meshgrid(found.x - 639.5, found.y - 359.5)) / 500
    turn = np.sqrt(1 / 0.9)
    known = np.isfinite(found.length)
    assert known[r < 0.98 * turn].all() and not known[r > 1.001 * turn].any()
    assert_allclose(found.length[known], 500 * 0.3 * r[known] ** 3, rtol=1e-9, atol=1e-9)
    assert found.covered == known.mean() < 1
