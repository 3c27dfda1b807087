"""How functions of the unknowns follow single observations, against dense algebra."""

import numpy as np
import pytest

from jaxbundle import leastsquares as ls
from jaxbundle.leastsquares.quality.sensitivity import pull_back

LEVELLED = ls.Kind("levelled difference", lambda a, b, dh: b - a - dh, of=("height", "height"))
SCALED = ls.Kind(
    "levelled with a rod", lambda a, b, read: b - a - read[0] * read[1], of=("height", "height")
)
EQUAL = ls.Kind("equal heights", lambda a, b, _: b - a, of=("height", "height"))


@pytest.mark.parametrize("covariance", [False, True])
def test_heights_follow_differences_and_conditions(covariance):
    """dx = Q·Jᵀ of a change of every measured difference by its σ, or by a column of the root of
    its covariance; a condition without a measured value changes as if it had one, 0."""
    random = np.random.default_rng(2)
    i, j = np.triu_indices(6, 1)
    measured, sigma = random.normal(size=15), random.uniform(0.5, 2, 15)
    given = {"covariance": (sigma**2)[:, None, None]} if covariance else {"sigma": sigma}
    same = ([1, 2], [3, 4])
    result = ls.adjust(
        [ls.Table("height", np.zeros(6), free=np.arange(6) > 0)],
        [LEVELLED((i, j), measured, **given), EQUAL(same, sigma=0.5)],
    )
    f = random.normal(size=(2, 6, 1))
    found = pull_back(result.solution, {"height": f})
    J = np.eye(6)[j] - np.eye(6)[i], np.eye(6)[same[1]] - np.eye(6)[same[0]]
    A = np.concatenate([J[0] / sigma[:, None], J[1] / 0.5])[:, 1:]
    expected = f[:, 1:, 0] @ np.linalg.inv(A.T @ A) @ A.T
    np.testing.assert_allclose(found["levelled difference"][..., 0], expected[:, :15], atol=1e-9)
    np.testing.assert_allclose(found["equal heights"][..., 0], expected[:, 15:], atol=1e-9)


def test_of_several_measured_arrays_the_residual_is_changed():
    """A difference is a reading times the scale of its rod: neither alone has the σ."""
    i, j = np.triu_indices(4, 1)
    reading, scale, sigma = np.arange(6.0), np.full(6, 1.01), np.full(6, 0.3)
    tables = [ls.Table("height", np.zeros(4), free=np.arange(4) > 0)]
    f = np.random.default_rng(1).normal(size=(1, 4, 1))
    of = lambda *sets: pull_back(ls.adjust(tables, [*sets]).solution, {"height": f})
    found = of(SCALED((i, j), (reading, scale), sigma=sigma))["levelled with a rod"]
    expected = of(LEVELLED((i, j), reading * scale, sigma=sigma))["levelled difference"]
    np.testing.assert_allclose(found, expected, atol=1e-9)
