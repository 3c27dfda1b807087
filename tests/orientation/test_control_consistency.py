"""Leave-one-out prediction of control points, against dense elimination and on simulated blocks."""

import dataclasses

import numpy as np
import pytest

from jaxbundle.orientation.control_consistency import Discrepancies, _predict, assess

ASSUMED = 0.05


def block(n, seed, sigma=0.5, open_columns=True, planimetric=False, stated=np.nan):
    """Discrepancies of n points of a block, 60 m wide, with 0.02 m of its own, and a shift."""
    rng = np.random.default_rng(seed)
    X = rng.uniform(0, 60, (n, 3)) * [1, 1, 0.1]
    d = sigma * rng.standard_normal((n, 3)) + [3.0, -2.0, 1.0]
    C = np.einsum("ij,ab->iajb", np.eye(n), 4e-4 * np.eye(3))
    G = np.tile(np.eye(3), (n, 1, 1))
    if not open_columns:
        C = C + np.einsum("a,ab->ab", np.full(3, 100.0), np.eye(3))[None, :, None, :]
        G = np.zeros((n, 3, 0))
    s = np.full((n, 3), stated)
    if planimetric:
        s[:, 2] = np.inf
    return X, Discrepancies(d, C, s, G)


@pytest.mark.parametrize("open_columns", [True, False])
def test_prediction_is_that_of_an_adjustment_without_the_point(open_columns):
    _, found = block(6, 1, open_columns=open_columns, stated=0.5)
    e, s, _ = _predict(found, np.ones(6, bool), [2], ASSUMED)
    keep = [k for k in range(6) if k != 2]
    S = (found.covariance.reshape(18, 18) + 0.25 * np.eye(18)).reshape(6, 3, 6, 3)
    A = S[keep][:, :, keep].reshape(15, 15)
    d = found.difference[keep].ravel()
    c = S[2][:, keep].reshape(3, 15)
    shift, more = np.zeros(3), 0.0
    if open_columns:  # kriging with an unknown shift
        G = np.tile(np.eye(3), (5, 1))
        N = np.linalg.inv(G.T @ np.linalg.solve(A, G))
        shift = N @ G.T @ np.linalg.solve(A, d)
        d = d - G @ shift
        R = np.eye(3) - c @ np.linalg.solve(A, G)
        more = R @ N @ R.T
    predicted = shift + c @ np.linalg.solve(A, d)
    covariance = S[2][:, 2] - c @ np.linalg.solve(A, c.T) + more
    np.testing.assert_allclose(e, found.difference[2] - predicted, atol=1e-9)
    np.testing.assert_allclose(s, np.sqrt(np.diag(covariance)), rtol=1e-9)


def test_sigma_is_estimated_and_good_points_are_kept():
    kept, sigmas = 0, []
    for seed in range(30):
        _, found = block(9, seed)
        result = assess(found, ASSUMED)
        kept += result.used.all()
        sigmas.append(result.sigma[0])
    # at 5 %: 25 or fewer of 30 have a probability of 0.3 %
    assert kept > 25
    mean = np.sqrt(np.mean(np.square(sigmas), 0))
    np.testing.assert_allclose(mean, 0.5, rtol=0.12)


@pytest.mark.parametrize("planimetric, stated", [(True, np.nan), (False, np.nan), (False, 0.5)])
def test_a_bad_point_is_named_and_hardly_ever_a_good_one(planimetric, stated):
    others = 0
    for seed in range(12):
        _, found = block(9, seed, planimetric=planimetric, stated=stated)
        found.difference[5, :2] += [4.5, -3.0]
        result = assess(found, ASSUMED)
        left = np.flatnonzero(~result.used).tolist()
        assert 5 in left and result.probability[5] < 5e-3 and not any(result.assumed)
        assert abs(result.error[5, 0] - 4.5) < 3 * 0.6
        others += len(left) > 1
    assert others <= 2  # at 5 %: more than 2 of 12 have a probability of 2 %


@pytest.mark.parametrize("seed", range(4))
def test_two_exchanged_points_do_not_hide_each_other(seed):
    X, found = block(9, seed, sigma=0.3)
    i, j = 2, 6
    X[j] = X[i] + [4.0, 3.0, 0.2]
    found.difference[i] += X[i] - X[j]
    found.difference[j] += X[j] - X[i]
    assert np.flatnonzero(~assess(found, ASSUMED).used).tolist() == [i, j]


@pytest.mark.parametrize("n", [6, 8, 9, 15])
def test_sigma_that_nothing_agrees_with_is_multiplied(n):
    """By about 50 = 1/0.02."""
    _, found = block(n, 3, sigma=1.0, stated=0.02)
    result = assess(found, ASSUMED)
    assert result.used.sum() >= n - 1 and 20 < result.factor < 100


@pytest.mark.parametrize("plane, least", [(np.inf, 1.0), (0.5, 0.05)])
def test_an_assumed_sigma_tests_nothing(plane, least):
    """Of five heights σ cannot be estimated without one of them: four, less one for the shift. None
    is improbable, whatever its error; X and Y, where they have a σ, are tested alone."""
    _, found = block(5, 2)
    found.difference[1, 2] += 1e3
    sigma = np.full((5, 3), [plane, plane, np.nan])
    result = assess(dataclasses.replace(found, sigma=sigma), ASSUMED)
    assert result.used.all() and least <= result.probability.min() <= result.probability.max() <= 1


def test_a_probability_is_at_most_one():
    """Also where points fit in the plane and in height better than half of all."""
    for seed in range(3):
        _, found = block(9, seed, stated=0.5)
        found = dataclasses.replace(found, difference=0.3 * found.difference)
        assert 0.9 < assess(found, ASSUMED).probability.max() <= 1


@pytest.mark.parametrize("n, stated", [(8, np.nan), (9, np.nan), (9, 0.01), (8, 0.01)])
def test_a_sigma_that_half_of_the_points_fit_is_not_multiplied(n, stated):
    """Four points contradict the others, which agree."""
    _, found = block(n, 3, sigma=0.01, stated=stated)
    found.difference[:4] += [[30, 0, 0], [0, 50, 10], [-60, 20, 0], [0, -80, -30]]
    result = assess(found, ASSUMED)
    assert np.flatnonzero(~result.used).tolist() == [0, 1, 2, 3] and result.factor == 1


def test_a_point_alone_has_an_assumed_sigma():
    """Of coordinates that a shift fits, no residual tells anything."""
    _, found = block(1, 0)
    result = assess(found, ASSUMED)
    assert all(result.assumed) and result.used.all() and np.all(result.sigma == ASSUMED)


def test_two_residuals_determine_a_sigma_but_test_nothing():
    """Of two points with a shift: redundancy 2 in the plane, so that σ̂² has the mean σ² with a
    relative σ of 1, of 400 draws 5 %; whatever it is, no point is left out by it."""
    variances = []
    for seed in range(400):
        _, found = block(2, seed)
        result = assess(found, ASSUMED)
        assert result.used.all()
        variances.append(result.sigma[0, 0] ** 2)
    np.testing.assert_allclose(np.mean(variances), 0.5**2, rtol=0.15)
