"""Transfer between images and ground, matching along the locus, clouds."""

import jax
import numpy as np
import pytest
import render
from scipy import ndimage

from jaxbundle.cameras import get_model
from jaxbundle.errors import InputError
from jaxbundle.measure import (
    View,
    correlation,
    filter_cloud,
    find_match,
    ground_point,
    image_point,
    image_to_image,
)
from jaxbundle.orientation import CameraPose

HEIGHT = 0.013
"""The plane that is photographed is Z = 0; matching is told that it lies here."""


def view(M, X0):
    parameters = np.array(render.LENS.parameters)
    return View(get_model("opencv"), parameters, CameraPose(X0 + [0, 0, HEIGHT], M))


POSES = (render.pose(5, -8, 10, (0.1, 0.08), 0.6), render.pose(-12, 14, -25, (0.12, 0.07), 0.5))
VIEWS = [view(*p) for p in POSES]


def texture(X, Y):
    grain = ndimage.gaussian_filter(np.random.default_rng(5).normal(size=(600, 600)), 3)
    grain = 0.5 + 0.12 * grain / grain.std()
    return ndimage.map_coordinates(grain, [1500 * Y + 150, 1500 * X + 150], order=1, mode="reflect")


@pytest.fixture(scope="module")
def pictures():
    return [render.photograph(render.LENS, *p, texture, seed=i) for i, p in enumerate(POSES)]


across = jax.jit(jax.vmap(image_to_image, (None, 0, None, None)))


def between(xy, i, j):
    return VIEWS[i], xy, HEIGHT, VIEWS[j]


def test_transfer_is_one_round_trip():
    xy = np.array([[100.0, 60.0], [240.0, 180.0], [400.0, 300.0]])
    there = jax.jit(jax.vmap(ground_point, (None, 0, None)))(VIEWS[0], xy, HEIGHT)
    X = np.asarray(there) - [0, 0, HEIGHT]
    np.testing.assert_allclose(X[:, 2], 0, atol=1e-15)
    np.testing.assert_allclose(render.LENS.image_of(*POSES[0], X), xy, atol=1e-9)
    other = across(*between(xy, 0, 1))
    np.testing.assert_allclose(other, render.LENS.image_of(*POSES[1], X), atol=1e-9)
    back = across(*between(np.asarray(other), 1, 0))
    np.testing.assert_allclose(back, xy, atol=1e-9)


def test_what_is_behind_has_no_image():
    up = POSES[0][1] + [0, 0, 2.0]
    assert np.isnan(image_point(VIEWS[0], up)).all()
    assert np.isnan(ground_point(VIEWS[0], np.array([240.0, 180.0]), 5.0)).all()


def test_the_best_match_is_at_the_height_of_the_ground(pictures):
    errors, heights = [], []
    for xy in np.array([[200.0, 150.0], [260.5, 210.25], [300.0, 120.0], [230.0, 260.0]]):
        found = find_match(*pictures, *VIEWS, xy, -0.05, 0.08)
        true = np.asarray(image_to_image(VIEWS[0], xy, HEIGHT, VIEWS[1]))
        errors.append(found.xy - true)
        heights.append(found.point[2])
        assert found.correlation > 0.9
        np.testing.assert_allclose(image_point(VIEWS[0], found.point), xy, atol=1e-6)
    assert np.abs(errors).max() < 0.2
    np.testing.assert_allclose(heights, HEIGHT, atol=2e-3)


def test_correlation_is_that_of_numpy():
    rng = np.random.default_rng(0)
    a, b = rng.normal(size=(2, 225))
    np.testing.assert_allclose(correlation(a, a + b), np.corrcoef(a, a + b)[0, 1], rtol=1e-12)
    assert correlation(a, np.ones(225)) == -1


def test_matching_says_what_is_wrong(pictures):
    place = np.array([200.0, 150.0])
    for arguments, said in (
        ((place, 1.0, 0.0), "Zmin 1 must be below"),
        ((place, 0.0, 0.1, 4), "window 4 must be an odd number"),
        ((np.array([3.0, 150.0]), 0.0, 0.1), r"window at \(3.0, 150.0\)"),
        ((place, 1.0, 2.0), "no height puts the window"),
    ):
        with pytest.raises(InputError, match=said):
            find_match(*pictures, *VIEWS, *arguments)


@pytest.mark.usefixtures("wrong_types")
def test_cubes():
    rng = np.random.default_rng(2)
    points = rng.uniform(-3, 3, (4000, 3))
    corners, counts = filter_cloud(points, 0.5, 4)
    for corner, number in zip(corners[::37], counts[::37]):
        inside = (points >= corner) & (points < corner + 0.5)
        assert inside.all(1).sum() == number
    assert counts.min() >= 4
    all_counts = filter_cloud(points, 0.5)[1]
    assert all_counts.sum() == 4000 and (all_counts >= 4).sum() == len(counts)
    with pytest.raises(InputError, match="cubes of 0 "):
        filter_cloud(points, 0.0)
    with pytest.raises(InputError, match="finite coordinates"):
        filter_cloud(points[:, :2], 1.0)
