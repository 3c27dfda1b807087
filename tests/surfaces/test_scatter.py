"""σ from the scatter of values on a smooth surface, against noise of known σ."""

import numpy as np
import pytest

from jaxbundle.surfaces.scatter import (
    CHI2_MEDIAN,
    MIN_VALUES,
    _blocks,
    missing_sigma,
    robust_factor,
    scatter_factor,
)

SIDE, MEDIAN = 16, 0.5


def smooth_surface(sigma, seed, shape=(256, 256)):
    """A surface of second order with noise of this σ, independent in every value."""
    y, x = np.mgrid[: shape[0], : shape[1]] / 50.0
    noise = np.random.default_rng(seed).normal(size=shape)
    return 3 + x - 2 * y + 0.5 * x * x + 0.3 * x * y - 0.2 * y * y + sigma * noise


@pytest.mark.parametrize("step", [1, 3])
def test_the_factor_of_noise_with_another_sigma(step):
    d = smooth_surface(0.03, 1)
    factors = scatter_factor(d, np.full_like(d, 0.02), step, SIDE, MEDIAN)
    assert len(factors) == 2
    assert factors == pytest.approx([2.25, 2.25], rel=0.06)


def test_what_is_missing_in_sigma_is_found():
    unit = 1 + np.linspace(0, 1, 256)[None] * np.ones((256, 1))
    d = smooth_surface(np.hypot(0.02, 0.03 * unit), 2)
    found = missing_sigma(d, np.full_like(d, 0.02), unit, 1, SIDE, MEDIAN)
    assert found == pytest.approx(0.03, rel=0.06)


def test_nothing_is_missing_in_a_sigma_that_is_large_enough():
    d = smooth_surface(0.02, 3)
    assert missing_sigma(d, np.full_like(d, 0.03), np.ones_like(d), 1, SIDE, MEDIAN) == 0


def test_few_values_tell_nothing():
    d = np.full((256, 256), np.nan)
    d[::4, ::4] = smooth_surface(0.02, 4)[::4, ::4]
    assert missing_sigma(d, np.full_like(d, 0.02), np.ones_like(d), 1, SIDE, MEDIAN) is None


def test_every_third_difference_is_used():
    """Of n columns there are n − 3 steps, each with the σ √(1 + 9 + 9 + 1)·σ; those of a surface of
    second order are noise alone."""
    step, sigma, blocks = 2, 0.1, 2
    a = np.random.default_rng(5).normal(size=(SIDE, blocks * SIDE + 3 * step))
    found = np.concatenate(_blocks(a, np.full_like(a, sigma), step, SIDE), axis=1)
    third = a
    for _ in range(3):
        third = third[:, step:] - third[:, :-step]
    np.testing.assert_allclose(found**2, third**2 / (20 * sigma**2))


def test_a_factor_of_few_values_is_the_given_one():
    """The median of squares of normal errors is that of χ² with one degree of freedom, 0.4549."""
    ratio = 2.0 * np.random.default_rng(6).normal(size=20_000)
    assert robust_factor(ratio) == pytest.approx(4, rel=0.05)
    assert pytest.approx(0.4549, abs=1e-4) == CHI2_MEDIAN
    few = np.append(ratio[:MIN_VALUES], np.nan)
    assert robust_factor(few, 1.7) == 1.7 and robust_factor(few) == 1.0
