"""Functions that promise derivatives keep them to second order, against differences of values."""


import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxbundle.orientation.homography import homography
from jaxbundle.orientation.intersection import intersection
from jaxbundle.orientation.relative import relative_orientation
from jaxbundle.orientation.resection import resection

RNG = np.random.default_rng(6)
POINTS = RNG.uniform([-1, -1, -0.5], [1, 1, 0.5], (9, 3))
TURN = np.array([[1, 0.02, -0.03], [-0.02, 1, 0.01], [0.03, -0.01, 1]])


def seen(points, centre, turn=np.eye(3)):
    rays = (points - centre) @ np.linalg.qr(turn)[0].T * np.sign(np.linalg.qr(turn)[1][0, 0])
    return rays[:, :2] / -rays[:, 2:]


def noisy(shape):
    return 3e-3 * RNG.normal(size=shape)


FIRST, SECOND = seen(POINTS, [0, 0, 5.0]), seen(POINTS, [2.0, 0.3, 5.0])
PLANE = POINTS[:, :2]
CENTRES = np.array([[0, 0, 5.0], [2, 0, 5], [0, 2, 4.5], [-1, 1, 5.5]])
RAYS = POINTS[0] - CENTRES + 5 * noisy((4, 3))

CASES = {
    "resection": (lambda xy: resection(xy, jnp.asarray(POINTS)).pose.X0, FIRST + noisy((9, 2))),
    "relative orientation": (
        lambda xy: relative_orientation(xy, SECOND).b, FIRST + noisy((9, 2))
    ),
    "intersection": (lambda d: intersection(CENTRES, d).X, RAYS),
    "homography": (lambda xy: homography(PLANE, xy)[0].ravel(), FIRST + noisy((9, 2))),
}


FURTHER = ("relative orientation", "homography")


@pytest.mark.parametrize("name", [
    pytest.param(name, marks=pytest.mark.further) if name in FURTHER else name for name in CASES
])  # fmt: skip
def test_second_derivatives(name):
    function, x = CASES[name]
    x, u = jnp.asarray(x), jnp.asarray(RNG.normal(size=x.shape))

    @jax.jit
    def along(h):
        first = lambda h: jax.jvp(lambda h: function(x + h * u), (h,), (1.0,))
        (value, slope), (_, curvature) = jax.jvp(first, (h,), (1.0,))
        return value, slope, curvature

    h = 1e-4
    _, slope, curvature = along(0.0)
    ends = {k: along(k * h) for k in (-2, -1, 1, 2)}
    for found, of in ((slope, 0), (curvature, 1)):
        difference = 8 * (ends[1][of] - ends[-1][of]) - (ends[2][of] - ends[-2][of])
        difference = np.asarray(difference) / (12 * h)
        assert np.abs(found - difference).max() < 1e-6 * np.abs(difference).max(), of
