"""Joint removal and inseparable blunders: rows and numbers, no photographs."""

import numpy as np

from jaxbundle.leastsquares.quality.correlation import correlation_matrix, total_correlation
from jaxbundle.leastsquares.quality.separability import choose_together, find_alternatives

CRITICAL, APART = 4.0, 3.29


def alternatives(design, blunders, suspect, noise=0.0):
    """Of observations of two rows each, whose errors are `blunders` and noise of that σ."""
    errors = np.asarray(blunders, float).ravel()
    errors = errors + noise * np.random.default_rng(4).normal(size=errors.size)
    v = errors - design @ np.linalg.lstsq(design, errors, rcond=None)[0]
    rows = [np.array([2 * i, 2 * i + 1]) for i in range(len(errors) // 2)]
    return find_alternatives(design, v, rows, suspect, CRITICAL, APART)


def views(directions):
    """Rows of image points of one point, from these directions: two axes across each."""
    rows = []
    for d in np.asarray(directions, float):
        rows += list(np.linalg.svd(d[None])[2][1:])
    return np.array(rows)


def test_two_rays_cannot_be_told_apart():
    """Four rows, three unknowns: one contradiction, which either ray explains in full."""
    design = views([(0, 0, 1), (1, 0.2, 1)])
    across = np.linalg.svd(design)[0][:, 3]
    assert alternatives(design, 40 * across * [1, 1, 0, 0], 0) == [1]


def test_a_blunder_among_many_rays_is_known():
    ring = np.linspace(0, 2 * np.pi, 6, endpoint=False)
    design = views([(np.cos(a), np.sin(a), 1) for a in ring])
    wrong = np.zeros((6, 2))
    wrong[2] = 8
    assert alternatives(design, wrong, 2, noise=1.0) == []


def test_rays_along_a_line_are_known_across_it_only():
    """Along the base three parallel views leave one contradiction, across it two."""
    design = np.zeros((6, 3))
    design[0::2, 0], design[1::2, 1], design[0::2, 2] = 1, 1, (-1, 0, 1)
    along, across = np.zeros((3, 2)), np.zeros((3, 2))
    along[1, 0], across[1, 1] = 15, 15
    assert alternatives(design, along, 1) == [0, 2] and alternatives(design, across, 1) == []


def test_two_blunders_that_share_no_unknown_are_both_known():
    """The rays of a fixed point: none of them explains what is wrong in another."""
    wrong = np.zeros((3, 2))
    wrong[0], wrong[1] = 10, 9
    assert alternatives(np.zeros((6, 3)), wrong, 0, noise=1.0) == []


def test_what_cannot_mask_each_other_goes_together():
    """Only one row of an own unknown; of a block what stays significant without the others."""
    tests, own = np.array([50.0, 40, 30, 20, 10]), np.array([0, 0, 1, 2, 3])
    block = np.array([0, 0, 0, 0, 1])
    choose = lambda leverage: choose_together(tests, own, block, np.full(5, leverage), CRITICAL)
    assert choose(0.0) == [0, 2, 3, 4]
    # 0.3·50 could make a test of 15 out of nothing, so 20 is in doubt and 30 is not.
    assert choose(0.3) == [0, 2, 4]
    assert choose(1.0) == [0, 4]


def test_correlations_of_a_covariance_matrix():
    """Held unknowns have none; a total correlation is that of an unknown with all others together,
    1 − σ²(given the others)/σ²."""
    rng = np.random.default_rng(3)
    A = rng.normal(size=(9, 4))
    C = np.zeros((5, 5))
    C[np.ix_([0, 1, 3, 4], [0, 1, 3, 4])] = A.T @ A
    found = correlation_matrix(C)
    expected, free = np.eye(5), [0, 1, 3, 4]
    expected[np.ix_(free, free)] = np.corrcoef(np.concatenate([A, -A]), rowvar=False)
    np.testing.assert_allclose(found, expected, atol=1e-12)
    alone = 1 / np.diag(np.linalg.inv(A.T @ A))
    np.testing.assert_allclose(total_correlation(A.T @ A), 1 - alone / np.diag(A.T @ A))
