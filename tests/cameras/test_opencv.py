"""The pixel models against OpenCV itself."""

import jax
import numpy as np
import pytest
from camera_cases import CASES
from numpy.testing import assert_allclose

from jaxbundle import cameras

CASE = {case.name: case for case in CASES}


def rays(max_angle, n=200):
    """Rays [r, s, q] of any length within `max_angle` (radians) of the optical axis."""
    rng = np.random.default_rng(0)
    angle, azimuth = max_angle * np.sqrt(rng.uniform(size=n)), rng.uniform(0, 2 * np.pi, n)
    length = rng.uniform(1, 9, n)
    return length[:, None] * np.stack(
        [np.sin(angle) * np.cos(azimuth), np.sin(angle) * np.sin(azimuth), -np.cos(angle)], 1
    )


def ours(model, values, points):
    p = tuple({**cameras.default_parameters(model), **values}[n] for n in model.parameters)
    return np.stack(jax.vmap(lambda x: cameras.project(model, p, *x))(points), 1)


def matrix(values):
    return np.array([
        [values["fx"], 0, values["cx"]], [0, values["fy"], values["cy"]], [0, 0, 1]
    ])


@pytest.mark.parametrize("coefficients", [4, 5, 8, 12])
def test_opencv_equals_project_points(coefficients):
    cv2 = pytest.importorskip("cv2")
    case = CASE["opencv"]
    used = case.model.parameters[: 4 + coefficients]
    values = {name: case.values[name] for name in used}
    points = rays(0.5)
    theirs, _ = cv2.projectPoints(
        points * [1, -1, -1], np.zeros(3), np.zeros(3), matrix(values),
        np.array([values[name] for name in used[4:]]),
    )
    assert_allclose(ours(case.model, values, points), theirs[:, 0], atol=1e-10)


def test_kannala_brandt_equals_fisheye_project_points():
    cv2 = pytest.importorskip("cv2")
    case = CASE["kannala-brandt"]
    points = rays(1.5)
    theirs, _ = cv2.fisheye.projectPoints(
        (points * [1, -1, -1])[:, None], np.zeros(3), np.zeros(3), matrix(case.values),
        np.array([case.values[f"k{i}"] for i in (1, 2, 3, 4)]),
    )
    assert_allclose(ours(case.model, case.values, points), theirs[:, 0], atol=1e-9)


@pytest.mark.parametrize("degrees", [0, 1e-6, 1, 1.8, 1.82, 45, 89.9, 90, 90.1, 120, 179])
def test_fisheye_is_equidistant_and_smooth_from_the_axis_to_beyond_90_degrees(degrees):
    model, f, psi = cameras.get_model("kannala-brandt"), 400.0, 0.6
    theta = np.deg2rad(degrees)
    p = (f, f, 640.0, 480.0, 0.0, 0.0, 0.0, 0.0)
    direction = np.array([np.cos(psi), np.sin(psi)])
    ray = np.array([*(np.sin(theta) * direction * [1, -1]), -np.cos(theta)])
    u, v = cameras.project(model, p, *ray)
    assert_allclose((u - p[2], v - p[3]), f * theta * direction, rtol=1e-12, atol=1e-12)
    assert_allclose(cameras.image_ray(model, p, u, v), ray, atol=1e-14)

    # the derivative across the ray: f/ρ·θ azimuthally, f radially, in units of the ray's length
    J = np.array(jax.jacfwd(lambda x: cameras.project(model, p, *x))(ray))
    radial = np.array([*(np.cos(theta) * direction * [1, -1]), np.sin(theta)])
    azimuthal = np.array([-direction[1], -direction[0], 0])
    across = theta / np.sin(theta) if degrees else 1.0
    assert_allclose(J @ ray, 0, atol=1e-9)
    assert_allclose(J @ radial, f * direction, atol=1e-8)
    assert_allclose(J @ azimuthal, f * across * np.array([-direction[1], direction[0]]), rtol=1e-9)


def test_the_fisheye_has_no_ray_beyond_180_degrees():
    model = cameras.get_model("kannala-brandt")
    p = (400.0, 400.0, 640.0, 480.0, 0.0, 0.0, 0.0, 0.0)
    assert not np.any(np.isnan(cameras.image_ray(model, p, 640 + 1250.0, 480.0)))
    assert np.all(np.isnan(cameras.image_ray(model, p, 640 + 1260.0, 480.0)))
