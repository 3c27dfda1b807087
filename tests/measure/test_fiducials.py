"""Fiducial marks against numpy's least squares, published figures, Monte Carlo; pixels and back."""

import numpy as np
import pytest

from jaxbundle.errors import InputError
from jaxbundle.measure import fit_fiducials, image_from_pixel, pixel_from_image

MARKS = np.array([[106.0, 106.0], [-106.0, 106.0], [-106.0, -106.0], [106.0, -106.0],
                  [110.0, 0.0], [0.0, 110.0], [-110.0, 0.0], [0.0, -110.0]])  # fmt: skip
SIZE, PITCH = (15333, 15200), (0.015, 0.0148)


def scanned(noise=0.0, seed=0):
    """Pixels of the marks in a slightly rotated, scaled and sheared scan."""
    rng = np.random.default_rng(seed)
    A = np.array([[66.61, 0.9], [0.7, -66.59]])
    return MARKS @ A.T + [7560.9, 7560.3] + noise * rng.normal(size=MARKS.shape)


def designs(kind, xy):
    """Design matrix of the linear transformations, row x and row y of each mark."""
    x, y = xy.T
    one, nil = np.ones_like(x), np.zeros_like(x)
    if kind == "similarity":
        rows = np.stack([x, -y, one, nil], 1), np.stack([y, x, nil, one], 1)
    else:
        rows = (np.stack([x, y, one, nil, nil, nil], 1), np.stack([nil, nil, nil, x, y, one], 1))
    return np.stack(rows, 1).reshape(2 * len(x), -1)


@pytest.mark.parametrize("kind", ["similarity", "affine"])
def test_against_linear_least_squares(kind):
    xy = scanned(0.5)
    if kind == "similarity":
        xy = xy * [1, -1]
    found = fit_fiducials(xy, MARKS, kind)
    A = designs(kind, xy)
    solution, square, *_ = np.linalg.lstsq(A, MARKS.ravel(), rcond=None)
    np.testing.assert_allclose(found.parameters, solution, rtol=1e-9, atol=1e-12)
    redundancy = 16 - A.shape[1]
    assert found.redundancy == redundancy
    assert found.sigma0 == pytest.approx(np.sqrt(square[0] / redundancy))
    np.testing.assert_allclose(found.residuals.ravel(), A @ solution - MARKS.ravel(), atol=1e-10)
    covariance = found.sigma0**2 * np.linalg.inv(A.T @ A)
    scale = np.sqrt(np.outer(np.diag(covariance), np.diag(covariance)))
    np.testing.assert_allclose(found.covariance / scale, covariance / scale, atol=1e-6)


def test_projective_marks():
    """Exact marks exactly; the σ of its parameters by Monte Carlo."""
    H = np.array([[0.015, 2e-4, -110], [1e-4, -0.0151, 112], [3e-7, -2e-7, 1]])
    w = np.c_[scanned(), np.ones(8)] @ H.T
    target = w[:, :2] / w[:, 2:]
    found = fit_fiducials(scanned(), target, "projective")
    np.testing.assert_allclose(found.parameters, H.ravel()[:8], rtol=1e-6)
    assert np.abs(found.residuals).max() < 1e-9
    rng = np.random.default_rng(1)
    draws = [fit_fiducials(scanned(), target + 0.01 * rng.normal(size=target.shape), "projective")
             for _ in range(300)]  # fmt: skip
    spread = np.std([d.parameters for d in draws], axis=0)
    stated = np.sqrt(np.mean([np.diag(d.covariance) for d in draws], axis=0))
    np.testing.assert_allclose(stated, spread, rtol=0.15)


def test_points_follow_the_marks_and_weights_count():
    found = fit_fiducials(scanned(), MARKS)
    np.testing.assert_allclose(found(scanned()), MARKS, atol=1e-9)
    spoilt = MARKS.copy()
    spoilt[2] += 5
    weights = np.array([1.0, 1, 0, 1, 1, 1, 1, 1])
    again = fit_fiducials(scanned(), spoilt, weights=weights)
    np.testing.assert_allclose(again.parameters, found.parameters, rtol=1e-9)
    assert "affine transformation of 8 marks" in str(found)


def test_a_mark_of_weight_0_is_as_good_as_none():
    xy, kept = scanned(0.5), np.arange(8) != 2
    found = fit_fiducials(xy, MARKS, weights=1.0 * kept)
    without = fit_fiducials(xy[kept], MARKS[kept])
    assert found.redundancy == without.redundancy == 8
    assert found.sigma0 == pytest.approx(without.sigma0)
    assert len(found.residuals) == 8


@pytest.mark.parametrize("weights, said", [
    ([1.0] * 7, "expected 8 weights"), ([-1.0] + [1.0] * 7, "one of 0 or more for each mark"),
    ([1.0, 1.0] + [0.0] * 6, "2 fiducial marks of weight above 0 are too few for the affine"),
])  # fmt: skip
def test_weights_that_cannot_be_used(weights, said):
    with pytest.raises(InputError, match=said):
        fit_fiducials(scanned(), MARKS, weights=weights)


@pytest.mark.usefixtures("wrong_types")
@pytest.mark.parametrize("change, said", [
    (lambda a, b: (a[:2], b[:2]), "2 fiducial marks are too few for the affine"),
    (lambda a, b: (a[:3], b), r"\(3, 2\) and \(8, 2\)"),
    (lambda a, b: (a * [1, 0], b), "do not determine the affine"),
    (lambda a, b: (a * np.nan, b), "must be a finite number"),
])  # fmt: skip
def test_marks_that_cannot_be_used(change, said):
    with pytest.raises(InputError, match=said):
        fit_fiducials(*change(scanned(), MARKS))
    with pytest.raises(InputError, match="did you mean 'affine'"):
        fit_fiducials(scanned(), MARKS, "afine")


def test_pixels_and_millimetres():
    corners = np.array([[-0.5, -0.5], [15332.5, 15199.5], [7666.0, 7599.5]])
    half = np.array(SIZE) * PITCH / 2
    expected = np.array([[-half[0], half[1]], [half[0], -half[1]], [0, 0]])
    np.testing.assert_allclose(image_from_pixel(corners, SIZE, PITCH), expected, atol=1e-12)
    np.testing.assert_allclose(pixel_from_image(expected, SIZE, PITCH), corners, atol=1e-9)
