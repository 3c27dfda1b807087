"""Data snooping: which of the removed observations stay removed; the scale of residuals."""

import inspect
from types import SimpleNamespace

import numpy as np
import pytest

import jaxbundle
from jaxbundle import leastsquares
from jaxbundle.leastsquares.quality.robust import Reweighted, robust_scale
from jaxbundle.leastsquares.quality.snooping import RemovedRow, _without_passing, snoop


@pytest.mark.parametrize("passing, rows", [
    ((), (3, 4, 5)), ((3,), (4, 5)), ((4,), (3, 5)), ((3, 4, 5), (3, 4, 5)),
])  # fmt: skip
def test_of_inseparable_observations_those_that_pass_come_back(passing, rows):
    """If each passes without the others, they contradict each other: which one is wrong remains
    unknown, and all stay removed. A single one that passes comes back."""
    together, single = RemovedRow("ray", 3, None, 9.0, (4, 5)), RemovedRow("height", 3, None, 5.0)
    passed = {("ray", row, None) for row in passing}
    (left, other) = _without_passing([together, single], passed)
    assert left.rows == rows and other == single
    assert list(_without_passing([single], {("height", 3, None)})) == []


@pytest.mark.parametrize("redundancy, unknowns, share", [
    (50, 50, 0.5), (60, 0, 1.0), (1, 10**6, 1e-3),
])  # fmt: skip
def test_a_robust_scale_counts_the_share_of_redundancy(redundancy, unknowns, share):
    """Residuals are smaller than errors by the root of it; of less than a thousandth they show
    nothing, and no division by nearly 0 makes the rest blunders. The median of |v| is 0.6745 s."""
    counts = SimpleNamespace(redundancy=redundancy, unknowns=unknowns, datum=0)
    problem = SimpleNamespace(counts=counts, weights=lambda name: np.ones((5, 1)))
    found = robust_scale(problem, {"height": np.array([0.1, 3.0, 0.2, 0.3, 9.0])})
    assert found == pytest.approx(0.3 / 0.67449 / np.sqrt(share), rel=1e-5)
    assert robust_scale(problem, {"height": np.zeros(5)}) > 0


@pytest.mark.parametrize(
    "function", [snoop, Reweighted.suspects, leastsquares.adjust, jaxbundle.adjust]
)
def test_the_level_is_one_for_all_tests_of_single_residuals(function):
    """α₀ = 0.1 % (Baarda 1968)."""
    assert inspect.signature(function).parameters["significance"].default == 0.001
