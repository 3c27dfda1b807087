"""Targets on rendered photographs; ellipses against exact points, OpenCV and Monte Carlo."""

import cv2
import jax
import numpy as np
import pytest
import render
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from jaxbundle.cameras import get_model
from jaxbundle.errors import InputError
from jaxbundle.measure import (
    centre_by_ellipse,
    centre_by_grey_values,
    circle_centre_shift,
    fit_ellipse,
)
from jaxbundle.measure.spots import noise_of, otsu
from jaxbundle.orientation import CameraPose

SPACING = 0.06
PLACES = np.array([[i * SPACING, j * SPACING, 0.0] for i in range(5) for j in range(4)])
UP = np.array([0.0, 0.0, 1.0])
METHODS = (centre_by_grey_values, centre_by_ellipse)
shift_of_all = jax.jit(
    jax.vmap(circle_centre_shift, (None, None, None, 0, None, None)), static_argnums=0
)


def scene(radius, bright, tilt, blur, seed=0):
    """A photograph of 20 discs, and the centres of their images."""
    M, X0 = render.pose(tilt, -tilt, 40 * (tilt > 0), (0.12, 0.09), 0.55)
    pattern = render.discs(PLACES[:, :2], radius, bright, margin=0.03)
    picture = render.photograph(render.LENS, M, X0, pattern, blur, seed=seed)
    shift = shift_of_all(
        get_model("opencv"), render.LENS.parameters, CameraPose(X0, M), PLACES, UP, radius
    )
    return picture, render.LENS.image_of(M, X0, PLACES) + np.asarray(shift)


@pytest.mark.parametrize("bright", [False, True])
@pytest.mark.parametrize(
    "radius, tilt, blur", [(0.003, 0, 0.7), (0.004, 25, 1.2), (0.007, 20, 0.7)]
)
def test_centres_are_right_to_three_hundredths_of_a_pixel(radius, tilt, blur, bright):
    picture, true = scene(radius, bright, tilt, blur)
    for measure in METHODS:
        found = [measure(picture, place + [1.4, -1.2]) for place in true]
        error = np.array([t.xy for t in found]) - true
        assert np.sqrt((error**2).mean()) < 0.03
        assert all(t.bright == bright for t in found)
        normalised = error / np.array([t.sigma for t in found])
        assert 0.5 < np.sqrt((normalised**2).mean()) < 2.5


def test_sigma_of_grey_values_follows_the_noise():
    """20 targets under 12 draws of noise, against the σ each of them states."""
    picture, true = scene(0.004, False, 0, 1.0)
    rng = np.random.default_rng(1)
    found = []
    for _ in range(12):
        noisy = picture + 8 * rng.normal(size=picture.shape)
        found.append([centre_by_grey_values(noisy, place) for place in true])
    spread = np.array([[t.xy for t in row] for row in found]).std(0, ddof=1)
    sigma = np.array([[t.sigma for t in row] for row in found]).mean(0)
    assert np.sqrt((spread**2).mean() / (sigma**2).mean()) == pytest.approx(1, abs=0.2)
    assert np.mean([[t.noise for t in row] for row in found]) == pytest.approx(8.25, rel=0.1)


def test_axes_are_those_of_the_projected_circle():
    M, X0 = render.pose(0, 35, 0, (0.12, 0.09), 0.55)
    place = PLACES[9]
    picture = render.photograph(render.LENS, M, X0, render.discs(PLACES[:, :2], 0.008, margin=0.03))
    t = np.linspace(0, 2 * np.pi, 60, endpoint=False)
    rim = place + 0.008 * np.stack([np.cos(t), np.sin(t), 0 * t], 1)
    rim = render.LENS.image_of(M, X0, rim)
    (_, _), (b, a), _ = cv2.fitEllipseDirect(rim.astype(np.float32))
    found = centre_by_ellipse(picture, render.LENS.image_of(M, X0, place[None])[0])
    np.testing.assert_allclose(found.axes, sorted([a / 2, b / 2])[::-1], atol=0.1)


@pytest.mark.parametrize("measure", METHODS)
def test_what_is_no_target_is_refused(measure):
    picture, true = scene(0.004, False, 0, 0.7)
    noise = np.random.default_rng(0).normal(100, 3, (60, 60))
    with pytest.raises(InputError, match=r"at \(30.0, 30.0\): no target stands out"):
        measure(noise, (30, 30))
    with pytest.raises(InputError, match="outside the image of 480 × 360"):
        measure(picture, (480, 20))
    x, y = np.rint(true[0]).astype(int)
    with pytest.raises(InputError, match="reaches the edge of the image"):
        measure(picture[y - 40 : y + 40, x : x + 30], (1, 40))


def test_threshold_and_noise():
    rng = np.random.default_rng(0)
    two = np.where(rng.uniform(size=(80, 80)) < 0.3, 180.0, 60.0) + 5 * rng.normal(size=(80, 80))
    assert 80 < otsu(two) < 160
    slope = np.add.outer(np.arange(90.0), 2 * np.arange(90.0))
    assert noise_of(slope + 7 * rng.normal(size=(90, 90))) == pytest.approx(7, rel=0.06)
    eight_bits = (100 + 7 * rng.normal(size=(90, 90))).astype(np.uint8)
    assert noise_of(eight_bits) == pytest.approx(7, rel=0.06)


def ellipse_points(centre, a, b, angle, t):
    c, s = np.cos(angle), np.sin(angle)
    return centre + np.stack([a * np.cos(t), b * np.sin(t)], 1) @ np.array([[c, s], [-s, c]])


def test_exact_ellipse():
    t = np.linspace(0.3, 4.4, 16)
    xy = ellipse_points([310.2, -41.5], 9.0, 5.0, 0.7, t)
    found = jax.jit(fit_ellipse)(xy, np.ones(16))
    np.testing.assert_allclose(found.centre, [310.2, -41.5], atol=1e-5)
    np.testing.assert_allclose(found.axes, [9, 5], atol=1e-5)
    np.testing.assert_allclose(found.angle, 0.7, atol=1e-5)


def test_ellipse_against_least_distances_and_its_own_covariance():
    """2000 draws: the covariance stated is that of the sample; one is near the geometric fit."""
    rng = np.random.default_rng(3)
    t = np.linspace(0, 2 * np.pi, 32, endpoint=False)
    exact = ellipse_points([20.0, 30.0], 8.0, 6.0, -0.4, t)
    noisy = exact + 0.05 * rng.normal(size=(2000, 32, 2))
    found = jax.jit(jax.vmap(fit_ellipse))(noisy)
    spread = np.cov(np.asarray(found.centre).T)
    stated = np.asarray(found.covariance).mean(0)
    np.testing.assert_allclose(np.diag(stated), np.diag(spread), rtol=0.12)
    np.testing.assert_allclose(np.asarray(found.sigma0).mean(), 0.05, rtol=0.03)

    def distances(q):
        x, y, a, b, angle = q
        turn = Rotation.from_rotvec([0, 0, -angle]).as_matrix()[:2, :2]
        away = (noisy[0] - [x, y]) @ turn.T
        for_each = np.linspace(0, 2 * np.pi, 4000)
        rim = np.stack([a * np.cos(for_each), b * np.sin(for_each)], 1)
        return np.linalg.norm(away[:, None] - rim, axis=2).min(1)

    peer = least_squares(distances, [20, 30, 8, 6, -0.4], diff_step=1e-4)
    np.testing.assert_allclose(found.centre[0], peer.x[:2], atol=0.01)


def test_eccentricity_is_that_of_the_projected_rim():
    """Without distortion exact; against the ellipse through the projected rim."""
    model = get_model("brown")
    p = (35.0, 0.2, -0.1) + 8 * (0.0,)
    M, X0 = render.pose(20, 40, 10, (0.0, 0.0), 2.0)
    normal = Rotation.from_euler("xyz", [10, -15, 0], degrees=True).as_matrix()[:, 2]
    a = np.linalg.svd(normal[None])[2][1:]
    X, t = np.array([0.1, 0.2, 0.05]), np.linspace(0, 2 * np.pi, 32, endpoint=False)
    rim = X + 0.3 * (np.cos(t)[:, None] * a[0] + np.sin(t)[:, None] * a[1])

    def image(X):
        r, s, q = M @ (X - X0).T
        return np.stack([0.2 - 35 * r / q, -0.1 - 35 * s / q], -1)

    centre = jax.jit(fit_ellipse)(image(rim), np.ones(32)).centre
    pose = CameraPose(X0, M)
    shift = jax.jit(circle_centre_shift, static_argnums=0)(model, p, pose, X, normal, 0.3)
    np.testing.assert_allclose(shift, centre - image(X), atol=1e-5)
    assert np.abs(shift).max() > 0.1
