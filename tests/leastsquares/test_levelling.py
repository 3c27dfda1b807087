"""A problem other than a bundle: a levelling net, with a held height or without, against dense
algebra."""

import numpy as np
import pytest

from jaxbundle import leastsquares as ls

HEIGHTS, SIGMA = 12, 0.01
LEVELLED = ls.Kind("levelled difference", lambda a, b, dh: b - a - dh, of=("height", "height"))


def net():
    """Rows of the differences, their values, and approximate heights."""
    random = np.random.default_rng(0)
    height = 10 * random.normal(size=HEIGHTS)
    i, j = np.triu_indices(HEIGHTS, 1)
    some = random.random(len(i)) < 0.4
    i, j = i[some], j[some]
    measured = height[j] - height[i] + SIGMA * random.normal(size=len(i))
    return i, j, measured, height + random.normal(size=HEIGHTS)


@pytest.mark.parametrize("held", [True, False], ids=["a height held", "inner constraints"])
def test_against_dense_algebra(held):
    i, j, measured, start = net()
    free = np.ones(HEIGHTS)
    free[0] = 0 if held else 1
    result = ls.adjust(
        [ls.Table("height", start, free=free)],
        [LEVELLED(rows=(i, j), measured=measured, sigma=SIGMA)],
        datum="given" if held else "inner",
    )  # fmt: skip

    J = (np.eye(HEIGHTS)[j] - np.eye(HEIGHTS)[i]) / SIGMA
    moving = np.flatnonzero(free)
    N = J.T @ J
    Q = np.zeros_like(N)
    if held:
        Q[np.ix_(moving, moving)] = np.linalg.inv(N[np.ix_(moving, moving)])
    else:
        Q = np.linalg.pinv(N)
    expected = start - Q @ J.T @ (J @ start - measured / SIGMA)
    np.testing.assert_allclose(result["height"].value, expected, atol=1e-9)
    v = J @ expected - measured / SIGMA
    assert result.counts.redundancy == len(i) - HEIGHTS + 1
    assert result.vtpv == pytest.approx(v @ v)
    sigma = result.sigma0 * np.sqrt(np.diag(Q))
    np.testing.assert_allclose(result["height"].sigma, sigma, rtol=1e-9, atol=1e-12)
    r = result.redundancy("levelled difference")
    np.testing.assert_allclose(r, 1 - np.einsum("ij,jk,ik->i", J, Q, J), atol=1e-9)
    ends = result.covariance(lambda tables: tables["height"][np.array([3, 7])])
    np.testing.assert_allclose(ends, result.sigma0**2 * Q[np.ix_([3, 7], [3, 7])], atol=1e-12)
