"""Quantiles of the normal, χ², t and τ distributions, by bisection on jax's own functions."""

import math

import jax.numpy as jnp
from jax.scipy import special


def _bisect(cdf, probability: float, low: float, high: float) -> float:
    while cdf(high) < probability:
        high *= 2
    for _ in range(200):
        middle = 0.5 * (low + high)
        if middle in (low, high):
            break
        low, high = (middle, high) if cdf(middle) < probability else (low, middle)
    return 0.5 * (low + high)


def normal_quantile(probability: float) -> float:
    """z with Φ(z) = probability."""
    return float(special.ndtri(jnp.asarray(probability)))


def chi2_cdf(x: float, degrees: float) -> float:
    """P(χ² ≤ x) with the given degrees of freedom."""
    return float(special.gammainc(degrees / 2, x / 2))


def chi2_quantile(probability: float, degrees: float) -> float:
    """x with P(χ² ≤ x) = probability."""
    return _bisect(lambda x: chi2_cdf(x, degrees), probability, 0.0, 2.0 * degrees + 10)


def t_cdf(t: float, degrees: float) -> float:
    """P(T ≤ t) of Student's distribution."""
    tail = 0.5 * float(special.betainc(degrees / 2, 0.5, degrees / (degrees + t * t)))
    return 1 - tail if t > 0 else tail


def t_quantile(probability: float, degrees: float) -> float:
    """t > 0 with P(T ≤ t) = probability, for probabilities over one half."""
    return _bisect(lambda t: t_cdf(t, degrees), probability, 0.0, 10.0)


def tau_quantile(probability: float, redundancy: float) -> float:
    """Critical value of Pope's τ (1976): √f·t/√(f − 1 + t²), t of f − 1 degrees of freedom."""
    f = redundancy
    if f < 2:
        return math.inf
    t = t_quantile(probability, f - 1)
    return math.sqrt(f) * t / math.sqrt(f - 1 + t * t)
