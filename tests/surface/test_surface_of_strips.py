"""Line scanner images by the face of all oriented images."""

import jax.numpy as jnp
import numpy as np
import pytest

from jaxbundle.pushbroom import Trajectory, attitude_table, make_image, position_table
from jaxbundle.pushbroom.scanner import FocalLine, LineTimes
from jaxbundle.surface.ground import ScannerView
from jaxbundle.surface.views import line_of_sight

LINES, PIXELS = 120, 100


@pytest.fixture(scope="module")
def view():
    """A strip over a local frame, 1000 m high, looking ahead, with a restless attitude."""
    t = np.linspace(-2.0, 4.0, 25)
    P = np.stack([0 * t, 50 * t, 1000 + 2 * np.sin(t)], 1)
    angles = np.stack([0.2 + 1e-3 * np.sin(2 * t), 1e-3 * np.cos(t), 0 * t], 1)
    parameters = jnp.array([120.0, *np.zeros(10)])
    optics = FocalLine(parameters, jnp.float64(0.05), jnp.float64((PIXELS - 1) / 2),
                       jnp.float64(0.0))  # fmt: skip
    image = make_image(
        Trajectory(position_table(t, P), attitude_table(t, angles, method="spline")),
        LineTimes(jnp.float64(0.0), jnp.float64(0.01)), optics, LINES, PIXELS,
    )  # fmt: skip
    return ScannerView("strip", np.zeros((LINES, PIXELS), np.float32), image, None, None)


def test_points_are_projected_where_they_came_from(view):
    uv = np.random.default_rng(0).uniform([2, 2], [PIXELS - 3, LINES - 3], (50, 2))
    h = np.linspace(-20, 40, 50)
    X = view.points(uv, h)
    np.testing.assert_allclose(view.parameter(X), h)
    np.testing.assert_allclose(view.project(X), uv, atol=1e-5)


def test_the_derivative_is_that_of_the_projection(view):
    uv = np.array([[30.0, 40], [70, 90]])
    X = view.points(uv, np.array([3.0, 8.0]))
    J = view.derivative(X)
    for k in range(3):
        step = 0.02 * np.eye(3)[k]
        slope = (view.project(X + step) - view.project(X - step)) / 0.04
        np.testing.assert_allclose(J[:, :, k], slope, atol=2e-4)
    along = view.points(uv, np.array([13.0, 18.0])) - X
    d = along / np.linalg.norm(along, axis=1, keepdims=True)
    np.testing.assert_allclose(np.abs(np.sum(d * line_of_sight(J), 1)), 1, atol=1e-9)
