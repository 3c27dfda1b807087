"""Rays of named points in an adjusted block, compared with exact projections."""

import dataclasses
from types import SimpleNamespace

import jax.numpy as jnp
import numpy as np
import pytest

from jaxbundle import Camera
from jaxbundle.cameras import get_model, project
from jaxbundle.geometry import matrix_from_omega_phi_kappa
from jaxbundle.reconstruction.block import ground_sample_distance
from jaxbundle.reconstruction.named import NamedMeasurements
from jaxbundle.reconstruction.oriented_block import FrameData, OrientedBlock
from jaxbundle.tiepoints.verified_pairs import central_distance

F, SIZE = 1000.0, (1600, 1200)
PIXELS = {"fx": F, "fy": F, "cx": 799.5, "cy": 599.5}
PERSPECTIVE = Camera("c", "opencv", PIXELS, image_size=SIZE)
DISTORTED = Camera("c", "opencv", PIXELS | {"k1": -0.1}, image_size=SIZE)
FISHEYE = Camera("c", "kannala-brandt", PIXELS | {"fx": 450.0, "fy": 450.0}, image_size=SIZE)
X0, ANGLES = np.array([3.0, -2.0, 7.0]), np.array([0.4, -0.3, 1.1])
M = np.asarray(matrix_from_omega_phi_kappa(jnp.asarray(ANGLES)))
AXES = np.concatenate([np.eye(2), -np.eye(2)])


def block_of(camera, xy, X):
    """A block of one photograph, with one point p at X, measured several times; the adjustment
    began with another principal distance."""
    images = SimpleNamespace(id=("i",), camera=np.zeros(1, int), sigma=np.full((1, 6), np.nan))
    start = dataclasses.replace(camera, parameters=camera.parameters | {"fx": 0.85 * F})
    network = SimpleNamespace(images=images, cameras=(start,), points=SimpleNamespace(id=("p",)))
    n = len(xy)
    problem = SimpleNamespace(
        network=network, used=np.ones(n, bool), image=np.zeros(n, int), point=np.zeros(n, int)
    )
    result = SimpleNamespace(
        problem=problem, point_values=X[None],
        image_values=np.append(X0, ANGLES)[None], camera_parameters=lambda id: camera.parameters,
    )  # fmt: skip
    named = NamedMeasurements(np.zeros(n, int), ("p",) * n, np.asarray(xy), np.ones((n, 2)))
    return OrientedBlock(result, FrameData(SimpleNamespace(id=("p",)), named, ("i",)))


def image_of(camera, X):
    p = tuple(camera.parameters.get(n, 0.0) for n in get_model(camera.model).parameters)
    return np.array(project(get_model(camera.model), p, *(M @ (X - X0))))


# tolerance: relative error of a miss of 10 pixels by what changes across it, distortion or, 10 px
# of 450 = 0.022 rad, tan 0.022 = 0.022·(1 + 0.022²/3), and rays that converge at the zenith
@pytest.mark.parametrize(
    ("camera", "away", "tolerance"),
    [
        (PERSPECTIVE, 0.0, 1e-6),
        (PERSPECTIVE, 35.0, 1e-6),
        (DISTORTED, 35.0, 0.02),
        (FISHEYE, 60.0, 0.02),
        (FISHEYE, 100.0, 0.02),
    ],
)
def test_a_miss_is_the_distance_from_the_measurement_in_the_image(camera, away, tolerance):
    """Degrees off the axis, of a fisheye also beyond 90: 10 pixels in any direction are 10."""
    a = np.radians(away)
    X = X0 + 50 * M.T @ [np.sin(a) * 0.8, np.sin(a) * 0.6, -np.cos(a)]
    xy = image_of(camera, X) + 10 * AXES
    block = block_of(camera, xy, X)
    point = block.measure("p")
    assert point.good.all()
    np.testing.assert_allclose(block.misses(point, X), 10.0, rtol=tolerance)
    # and behind the camera there is no image
    assert np.isinf(block.misses(point, 2 * X0 - X)).all()


def test_the_ground_sample_distance_is_that_of_the_depth():
    """Of a perspective image, a pixel of a plane parallel to it: depth/c, wherever it is seen."""
    for away in (0.0, 0.7):
        X = X0 + M.T @ [50 * away, 0.0, -50.0]
        block = block_of(PERSPECTIVE, image_of(PERSPECTIVE, X)[None], X)
        assert block.ground_sample_distance == pytest.approx(50.0 / F, rel=1e-6)
        assert ground_sample_distance(block.result) == pytest.approx(50.0 / F, rel=1e-6)
        # and where no named point has a position
        block.row_of_determined = {}
        assert block.ground_sample_distance == pytest.approx(50.0 / F, rel=1e-6)


def test_a_measurement_outside_the_range_of_its_camera_has_no_ray():
    """Nor a share of the ground sample distance; with K1 of −0.1 the image ends at r = 1.22."""
    X = X0 + M.T @ [5.0, 0.0, -50.0]
    xy = np.stack([image_of(DISTORTED, X), [3000.0, 599.5]])
    block = block_of(DISTORTED, xy, X)
    point = block.measure("p")
    assert point.good.tolist() == [True, False] and np.isnan(point.rays[1]).all()
    assert block.misses(point, X)[0] < 1e-6 and np.isinf(block.misses(point, X)[1])
    assert block.ground_sample_distance == pytest.approx(50.0 / F, rel=0.02)


@pytest.mark.parametrize("camera", [PERSPECTIVE, DISTORTED])
def test_the_principal_distance_in_the_middle_of_the_image(camera):
    """F, where there is no distortion."""
    assert central_distance(camera) == pytest.approx(F, rel=1e-5)
