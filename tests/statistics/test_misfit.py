"""Doubts about a priori σ and σ0, in words with the remedy."""

import math

import numpy as np
import pytest

from jaxbundle.adjustment.quality.misfit import (
    contradicts,
    doubt_of_baarda,
    doubt_of_fit,
    doubt_of_robust,
)
from jaxbundle.leastsquares.quality.distributions import critical_length


def test_chance_and_small_factors_are_no_contradiction():
    assert not contradicts(1.15, 10_000) and contradicts(1.49, 10_000)
    assert not contradicts(1.49, 4) and contradicts(1 / 1.49, 10_000)


@pytest.mark.parametrize("sigma0, scale, first", [
    (1.49, 1.45, "a priori σ that are too small (multiply them by 1.45"),
    (6.0, 1.05, "blunders (--snooping pope)"),
    (300.0, 250.0, "image coordinates with a mirrored axis"),
    (0.4, 0.4, "a priori σ that are too large"),
])  # fmt: skip
def test_the_likeliest_cause_comes_first(sigma0, scale, first):
    told = doubt_of_fit(sigma0, scale, 2000)
    assert f"vᵀPv/redundancy is {sigma0**2:.3g} (σ0 {sigma0:.3g}), not 1" in told
    assert told.split("likely cause", 1)[1].split(": ", 1)[1].startswith(first)


def test_nothing_is_said_of_what_fits():
    assert doubt_of_fit(1.1, 1.1, 2000) is doubt_of_robust(0.95, 2000) is None
    assert doubt_of_baarda(1.0, 3, 1000, 2000, 0.001) is doubt_of_fit(float("nan"), 1.0, 0) is None


@pytest.mark.parametrize("residuals", [1, 2, 3])
def test_the_longest_of_many_residuals(residuals):
    """The level of the longest of n is reached by 1 − (1 − P(χ²ₖ > t²))ⁿ; P in closed form."""
    t = critical_length(0.01, 500, residuals)
    plane, line = np.exp(-t * t / 2), math.erfc(t / math.sqrt(2))
    beyond = {1: line, 2: plane, 3: line + math.sqrt(2 / math.pi) * t * plane}[residuals]
    assert -np.expm1(500 * np.log1p(-beyond)) == pytest.approx(0.01, rel=1e-9)
