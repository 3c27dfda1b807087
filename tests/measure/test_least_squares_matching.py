"""Least squares matching of windows whose transformation is known."""

from functools import partial

import jax
import numpy as np
import pytest
from scipy import interpolate, ndimage

from jaxbundle.measure.least_squares_matching import (
    MatchingStatus,
    grey_value,
    match_least_squares,
    spline_coefficients,
)

LANES, SIDE, PIECE, NOISE = 200, 15, 33, 2.0
match = jax.jit(jax.vmap(match_least_squares))


@pytest.fixture(scope="module")
def texture():
    """A continuous surface: smooth noise, sampled four times as densely as the images."""
    rng = np.random.default_rng(1)
    fine = ndimage.gaussian_filter(rng.normal(size=(800, 800)), 7.0)
    coefficients = ndimage.spline_filter(fine / fine.std() * 40 + 120)
    return lambda xy: ndimage.map_coordinates(
        coefficients, [4 * xy[..., 1], 4 * xy[..., 0]], order=3, prefilter=False
    )


def grid(side):
    offset = np.arange(side) - side // 2
    return np.stack(np.meshgrid(offset, offset), -1).astype(float)


@pytest.fixture(scope="module")
def pairs(texture):
    """Windows, pieces of another image, and A from one to the other."""
    rng = np.random.default_rng(2)
    centre = rng.uniform(40, 160, (LANES, 1, 1, 2))
    A = np.eye(2) + 0.06 * rng.normal(size=(LANES, 2, 2))
    place = PIECE // 2 + rng.uniform(-0.5, 0.5, (LANES, 2))
    back = np.einsum("bij,bxyj->bxyi", np.linalg.inv(A), PIECE // 2 + grid(PIECE)[None]
                     - place[:, None, None])  # fmt: skip
    noise = lambda side: NOISE * rng.normal(size=(LANES, side, side))
    template = texture(centre + grid(SIDE)) + noise(SIDE)
    piece = 0.9 * texture(centre + back) - 7 + noise(PIECE)
    return template, piece, np.concatenate([A, place[..., None]], 2)


def started(truth, rng, error=0.7):
    start = truth.copy()
    start[:, :, :2] = np.eye(2)
    start[:, :, 2] += error * rng.uniform(-1, 1, (len(truth), 2))
    return start


def test_places_are_found_and_their_covariance_is_that_of_the_errors(pairs):
    template, piece, truth = pairs
    found = match(template, piece, started(truth, np.random.default_rng(3)))
    good = np.asarray(found.status) == MatchingStatus.CONVERGED
    assert good.mean() > 0.97
    e = np.asarray(found.place - truth[:, :, 2])[good]
    Q = np.linalg.inv(np.asarray(found.covariance)[good])
    normalised = np.sqrt(np.einsum("bi,bij,bj->b", e, Q, e) / 2)
    assert np.median(np.linalg.norm(e, axis=1)) < 0.03
    assert 0.85 < np.sqrt(np.mean(normalised**2)) < 1.3
    slope = np.asarray(found.affine - truth)[good, :, :2]
    assert np.sqrt(np.mean(slope**2)) < 0.01
    assert np.allclose(np.median(found.radiometry[good, 1]), 1 / 0.9, rtol=0.02)
    assert np.allclose(np.median(found.radiometry[good, 0]), 7 / 0.9, atol=2.0)


def test_a_bent_window_shifts_no_place(texture):
    """Terms of second order, as perspective and hills cause them, bias a match without them by
    their mean over the window; with them, errors are about those of flat windows."""
    rng = np.random.default_rng(8)
    lanes, bend, half = 128, 0.25, SIDE // 2
    centre = rng.uniform(40, 160, (lanes, 1, 1, 2))
    place = PIECE // 2 + rng.uniform(-0.5, 0.5, (lanes, 2))
    d = PIECE // 2 + grid(PIECE)[None] - place[:, None, None]
    x, y = d[..., 0] / half, d[..., 1] / half
    terms = np.stack([x * x, x * y, y * y], -1)
    # of the same sign everywhere, as on a summit: the errors would not average out
    q = bend * np.abs(rng.normal(size=(lanes, 1, 1, 2, 3)))
    bent = d - np.einsum("bxyij,bxyj->bxyi", np.broadcast_to(q, (*d.shape[:3], 2, 3)), terms)
    noise = lambda side: NOISE * rng.normal(size=(lanes, side, side))
    template = texture(centre + grid(SIDE)) + noise(SIDE)
    piece = texture(centre + bent) + noise(PIECE)
    start = np.concatenate([np.tile(np.eye(2), (lanes, 1, 1)), place[..., None]], 2)

    def errors(bend):
        one = partial(match_least_squares, reach=7, bend=bend)
        found = jax.jit(jax.vmap(one))(template, piece, start)
        good = np.asarray(found.status) == MatchingStatus.CONVERGED
        assert good.mean() > 0.95
        e = np.asarray(found.place - place)[good]
        Q = np.linalg.inv(np.asarray(found.covariance)[good])
        return e, np.sqrt(np.mean(np.einsum("bi,bij,bj->b", e, Q, e)) / 2)

    affine, over_sigma = errors(0.0)
    assert np.linalg.norm(affine.mean(0)) > 0.1 and over_sigma > 3
    second, over_sigma = errors(bend)
    assert np.linalg.norm(second.mean(0)) < 0.25 * np.linalg.norm(affine.mean(0))
    assert np.sqrt(np.mean(second**2)) < 0.05
    # residuals of noise are uncorrelated, and those left by fourteen unknowns slightly negatively
    # so: a covariance from their correlations is too small, also for flat windows
    assert 0.8 < over_sigma < 1.9


def test_what_cannot_be_matched_is_named(pairs):
    template, piece, truth = (a[:LANES].copy() for a in pairs)
    start = started(truth, np.random.default_rng(3), 0.0)
    template[0] = 100.0
    start[1, :, 2] = 2.0
    template[2] = np.linspace(0, 200, SIDE)  # an edge says nothing about the place along it
    piece[2] = np.linspace(0, 200 * PIECE / SIDE, PIECE)
    start[3, :, 2] += 9.0
    start[4] = np.nan
    found = match(template, piece, start)
    status = [MatchingStatus(int(s)) for s in found.status[:5]]
    assert status[0] == status[2] == MatchingStatus.NO_TEXTURE
    assert status[1] in (MatchingStatus.OUTSIDE, MatchingStatus.DIVERGED)
    assert MatchingStatus.CONVERGED not in status
    assert np.isinf(found.covariance[0]).all()
    assert (np.asarray(found.status[5:]) == 0).mean() > 0.97


def test_grey_values_of_a_cubic_surface_are_exact_away_from_the_edge():
    v, u = np.mgrid[:50, :52].astype(float) - 25
    surface = lambda u, v: 3 + 2 * u - v + 0.3 * u * v + 0.2 * u**2 - 0.01 * v**3
    coefficients = spline_coefficients(surface(u, v))
    for a, b in ((0.3, -0.8), (2.01, 1.99), (-3.0, 2.0)):
        value, slope = jax.value_and_grad(lambda p: grey_value(coefficients, p[0], p[1]))(
            np.array([a + 25, b + 25])
        )
        assert np.allclose(value, surface(a, b), atol=1e-9)
        expected = (2 + 0.3 * b + 0.4 * a, -1 + 0.3 * a - 0.03 * b**2)
        assert np.allclose(slope, expected, atol=1e-9)


@pytest.mark.parametrize("u", [0.0, 0.4, 5.6, 10.3, 11.0])
def test_grey_values_are_those_of_the_natural_spline_up_to_the_edge(u):
    """Of scipy, along rows and then along columns."""
    image = np.random.default_rng(0).normal(size=(9, 12))
    along = interpolate.CubicSpline(np.arange(12), image, axis=1, bc_type="natural")(u)
    down = interpolate.CubicSpline(np.arange(9), along, bc_type="natural")
    for v in (0.0, 0.7, 4.0, 7.2, 8.0):
        assert grey_value(spline_coefficients(image), u, v) == pytest.approx(down(v), abs=1e-12)


def test_smoothed_noise_draws_no_place_towards_the_middle_between_pixels(texture):
    """Mean and RMS of errors over σ, of windows a quarter of a pixel beside the grid."""
    rng = np.random.default_rng(5)
    centre = rng.integers(45, 155, (LANES, 1, 1, 2))

    def smoothed(side, shift):
        grey = texture(centre + grid(side + 8) - shift)
        grey = grey + 4.0 * rng.normal(size=grey.shape)
        return ndimage.gaussian_filter(grey, (0, 0.7, 0.7))[:, 4:-4, 4:-4]

    shift = np.array([0.25, -0.25])
    template, piece = smoothed(SIDE, 0 * shift), smoothed(PIECE, shift)
    truth = np.broadcast_to(np.eye(2, 3), (LANES, 2, 3)).copy()
    truth[:, :, 2] = PIECE // 2 + shift
    found = jax.jit(jax.vmap(partial(match_least_squares, blur=0.7)))(template, piece, truth)
    good = np.asarray(found.status) == MatchingStatus.CONVERGED
    assert good.mean() > 0.97
    e = np.asarray(found.place - truth[:, :, 2])[good]
    w = e / np.sqrt(np.einsum("bii->bi", np.asarray(found.covariance)[good]))
    assert (np.abs(w.mean(0)) < 0.25).all()
    assert (np.abs(np.sqrt(np.mean(w**2, 0)) - 1) < 0.15).all()
