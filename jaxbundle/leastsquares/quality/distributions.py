"""Quantiles of the normal, χ², t and τ distributions, tails of χ² and F, critical values."""

import functools
import importlib
import math
from types import ModuleType

# σ of a normal distribution by its median absolute deviation: 1/Φ⁻¹(¾) to five digits.
NORMAL_SIGMA_BY_MAD = 1.4826


@functools.cache
def _special() -> ModuleType:
    """scipy's functions, imported (a tenth of a second) only if needed."""
    return importlib.import_module("scipy.special")


def normal_quantile(probability: float) -> float:
    """z with Φ(z) = probability."""
    return float(_special().ndtri(probability))


def normal_probability(x: float) -> float:
    """Φ(x)."""
    return float(_special().ndtr(x))


def skewed_quantile(probability: float, skewness: float) -> float:
    """The quantile of the χ² distribution, shifted and scaled to the mean 0 and the variance 1,
    that has this skewness (of a negative one: mirrored): of sums of squares of normal numbers by
    their first three moments (Pearson 1959; Imhof 1961)."""
    if skewness < 0:
        return -skewed_quantile(1 - probability, -skewness)
    # χ² of ν has the skewness √(8/ν). A smaller one moves quantiles up to 3.7 by less than 3e-5,
    # (z² − 1)/6 times the skewness (Cornish and Fisher).
    if skewness < 1e-5:
        return normal_quantile(probability)
    shape = 4 / skewness**2
    return float((_special().gammaincinv(shape, probability) - shape) / math.sqrt(shape))


def chi2_quantile(probability: float, degrees: float) -> float:
    """x with P(χ² ≤ x) = probability."""
    return float(_special().chdtri(degrees, 1 - probability))


def t_quantile(probability: float, degrees: float) -> float:
    """t with P(T ≤ t) = probability, Student's distribution."""
    return float(_special().stdtrit(degrees, probability))


def chi2_tail(x: float, degrees: float) -> float:
    """P(χ² > x)."""
    return float(_special().chdtrc(degrees, x))


def f_tail(x: float, numerator: float, denominator: float) -> float:
    """P(F > x), Fisher's distribution."""
    return float(_special().fdtrc(numerator, denominator, x))


def tau_quantile(probability: float, redundancy: float) -> float:
    """Critical value of Pope's τ (1976): √f·t/√(f − 1 + t²), t of f − 1 degrees of freedom."""
    f = redundancy
    if f < 2:
        return math.inf
    t = t_quantile(probability, f - 1)
    return math.sqrt(f) * t / math.sqrt(f - 1 + t * t)


def critical_w(
    test: str, significance: float, observations: int, redundancy: float, sigma0: float
) -> float:
    """Critical value of |w|.

    `"baarda"` (1968): for a single observation, with the a priori σ; `"pope"` (1976): for the
    largest of n observations, α' = 1 − (1 − α)^(1/n), with the a posteriori σ0.
    """
    if test == "baarda":
        return normal_quantile(1 - significance / 2)
    return sigma0 * tau_quantile(1 - level_of_one(significance, observations) / 2, redundancy)


def critical_length(significance: float, vectors: int, residuals_each: int = 2) -> float:
    """Critical length of the longest of n vectors of k residuals each, in σ: t² ~ χ²ₖ; k = 2 in an
    image."""
    level = level_of_one(significance, vectors)
    return math.sqrt(chi2_quantile(1 - level, residuals_each))


def level_of_one(significance: float, tests: int) -> float:
    """The level of each of n tests with the given joint level."""
    return -math.expm1(math.log1p(-significance) / max(tests, 1))
