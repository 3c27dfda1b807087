"""The pixel models against OpenCV itself."""

from functools import partial

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from camera_cases import CASES, Case, image_rays, project
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


def ours(case, values, points):
    values = {**cameras.default_parameters(case.model), **values}
    return project(Case(case.name, values, case.centre, case.half), points)


def matrix(values):
    return np.array([
        [values["fx"], 0, values["cx"]], [0, values["fy"], values["cy"]], [0, 0, 1]
    ])


@pytest.mark.parametrize("coefficients", [4, 5, 8, 12])
def test_opencv_equals_project_points(coefficients):
    case = CASE["opencv"]
    used = case.model.parameters[: 4 + coefficients]
    values = {name: case.values[name] for name in used}
    points = rays(0.5)
    theirs, _ = cv2.projectPoints(
        points * [1, -1, -1], np.zeros(3), np.zeros(3), matrix(values),
        np.array([values[name] for name in used[4:]]),
    )
    assert_allclose(ours(case, values, points), theirs[:, 0], atol=1e-10)


def test_kannala_brandt_equals_fisheye_project_points():
    case = CASE["kannala-brandt"]
    points = rays(1.5)
    theirs, _ = cv2.fisheye.projectPoints(
        (points * [1, -1, -1])[:, None], np.zeros(3), np.zeros(3), matrix(case.values),
        np.array([case.values[f"k{i}"] for i in (1, 2, 3, 4)]),
    )
    assert_allclose(project(case, points), theirs[:, 0], atol=1e-9)


@partial(jax.jit, static_argnums=0)
@partial(jax.vmap, in_axes=(None, None, 0))
def image_derivative_and_ray(model, p, ray):
    xy = cameras.project(model, p, *ray)
    J = jax.jacfwd(lambda ray: jnp.stack(cameras.project(model, p, *ray)))(ray)
    return jnp.stack(xy), J, jnp.stack(cameras.image_ray(model, p, *xy))


def test_fisheye_is_equidistant_and_smooth_from_the_axis_to_beyond_90_degrees():
    f, psi = 400.0, 0.6
    p = (f, f, 640.0, 480.0, 0.0, 0.0, 0.0, 0.0)
    theta = np.deg2rad([0, 1e-6, 1, 1.8, 1.82, 45, 89.9, 90, 90.1, 120, 179])[:, None]
    direction, across = np.array([np.cos(psi), np.sin(psi)]), np.array([-np.sin(psi), np.cos(psi)])
    rays = np.hstack([np.sin(theta) * direction * [1, -1], -np.cos(theta)])
    model = cameras.get_model("kannala-brandt")
    xy, J, back = map(np.asarray, image_derivative_and_ray(model, p, rays))
    assert_allclose(xy - [640, 480], f * theta * direction, rtol=1e-12, atol=2e-13 * f)
    assert_allclose(back, rays, atol=1e-14)

    # along the ray nothing, radially f, azimuthally f·θ/sin θ, for a ray of length 1
    radial = np.hstack([np.cos(theta) * direction * [1, -1], np.sin(theta)])
    azimuthal = np.array([*across * [1, -1], 0])
    stretch = np.divide(theta, np.sin(theta), out=np.ones_like(theta), where=theta > 0)
    assert_allclose(np.einsum("nij,nj->ni", J, rays), 0 * xy, atol=1e-9)
    assert_allclose(np.einsum("nij,nj->ni", J, radial), f * direction + 0 * xy, atol=1e-9)
    assert_allclose(J @ azimuthal, f * stretch * across, atol=1e-9)


def test_the_fisheye_has_no_ray_beyond_180_degrees():
    p = dict(fx=400.0, fy=400.0, cx=640.0, cy=480.0, k1=0.0, k2=0.0, k3=0.0, k4=0.0)
    rays = image_rays(
        Case("kannala-brandt", p, (640, 480), (1300, 1)), [[1890.0, 480.0], [1900.0, 480.0]]
    )
    assert_allclose(np.isnan(rays), [[False] * 3, [True] * 3])
