"""A problem other than a bundle: a levelling net, with a held height or without, against dense
algebra."""

import sys

import numpy as np
import pytest

from jaxbundle import InputError
from jaxbundle import leastsquares as ls
from jaxbundle.leastsquares.quality.robust import robust_scale

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


def test_nothing_is_removed_from_exact_data():
    """Residuals are rounding: some of it is always larger than the rest allows."""
    for seed in range(12):
        random = np.random.default_rng(seed)
        height = random.normal(size=4)
        i, j = np.triu_indices(4, 1)
        exact = LEVELLED(rows=(i, j), measured=height[j] - height[i], sigma=SIGMA)
        result = ls.adjust(
            [ls.Table("height", np.zeros(4))], [exact], datum="inner", snooping="pope",
            significance=0.2,
        )  # fmt: skip
        assert not result.removed and result.sigma0 < 1e-9


@pytest.mark.parametrize("option", [{"estimate_components": True}, {"snooping": "pope"}])
def test_statistics_after_iterations_without_a_factor(option):
    i, j, measured, start = net()
    levelled = LEVELLED(rows=(i, j), measured=measured, sigma=2 * SIGMA)
    results = [
        ls.adjust([ls.Table("height", start)], [levelled], datum="inner", reduction=r, **option)
        for r in ("iterative", "dense")
    ]
    by_steps, direct = (result["height"] for result in results)
    np.testing.assert_allclose(by_steps.value, direct.value, atol=1e-9)
    np.testing.assert_allclose(by_steps.sigma, direct.sigma, rtol=1e-6)
    assert not results[0].unsettled


def test_without_a_factor_the_result_says_so(monkeypatch):
    i, j, measured, start = net()
    levelled = LEVELLED(rows=(i, j), measured=measured, sigma=SIGMA)
    # `ls.adjust` is the function.
    module = sys.modules["jaxbundle.leastsquares.adjust"]
    monkeypatch.setattr(module, "with_factor", lambda problem: problem)
    solve = lambda **option: ls.adjust(
        [ls.Table("height", start)], [levelled], datum="inner", reduction="iterative", **option
    )
    result = solve()
    assert result.converged and str(result).endswith("too large for statistics")
    for use in (lambda: result["height"], lambda: result.residuals("levelled difference")):
        with pytest.raises(InputError, match="too large for its statistics"):
            use()
    with pytest.raises(InputError, match="too large for them"):
        solve(snooping="pope")


def test_a_median_length_of_rows_with_one_residual():
    """Of normal residuals the robust scale is 1, also where the second of a row has no weight."""
    v = np.random.default_rng(0).normal(size=(4000, 2))
    shift = ls.Kind("shift", lambda a, m: a - m, of=("place",))
    sigma = np.where([True, False], np.ones((4000, 2)), np.inf)
    place = ls.Table("place", np.zeros((1, 2)), free=[[True, False]])
    problem = ls.make_problem([place], [shift((np.zeros(4000, int),), v, sigma=sigma)], None)
    scale = robust_scale(problem, {"shift": np.abs(v[:, 0])})
    assert scale == pytest.approx(1, abs=4 * 0.0186)  # σ of a median of |N|: 1.166/√n
