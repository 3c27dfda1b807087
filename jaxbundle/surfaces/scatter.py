"""Estimation of σ of points from the scatter on a smooth surface.

Third differences of values whose windows do not overlap,

    d₀ − 3·d₁ + 3·d₂ − d₃,    σ² = σ₀² + 9·σ₁² + 9·σ₂² + σ₃²,

are pure noise if the surface is smooth. The variance factor is a quantile of those of blocks.
"""

import numpy as np
from jaxtyping import Float
from scipy.optimize import brentq

from jaxbundle.leastsquares.quality.distributions import NORMAL_SIGMA_BY_MAD, chi2_quantile

# Minimum values for a variance factor: the median of n values of χ²₁ has the standard deviation
# 1/(2·f·√n), with the density f = 0.47 at the median 0.455; for 100 values 23 % of it.
MIN_VALUES = 100
# Median of χ² of one degree of freedom, 0.455.
CHI2_MEDIAN = chi2_quantile(0.5, 1)


def robust_sigma(values: Float[np.ndarray, " n"]) -> float:
    """σ by the median absolute deviation: half of the values may be anything."""
    return float(NORMAL_SIGMA_BY_MAD * np.median(np.abs(values - np.median(values))))


def robust_factor(ratio: Float[np.ndarray, " n"], otherwise: float = 1.0) -> float:
    """The variance factor of errors in units of their σ, by their median; `otherwise` for few."""
    ratio = ratio[np.isfinite(ratio)]
    if len(ratio) <= MIN_VALUES:
        return otherwise
    return float(np.median(ratio**2) / CHI2_MEDIAN)


def scatter_factor(
    d: Float[np.ndarray, "rows columns"],
    sigma: Float[np.ndarray, "rows columns"],
    step: int,
    side: int,
    quantile: float,
) -> list[float]:
    """The variance factor of values on a grid (NaN: none), along columns and rows, by differences
    over `step`, of blocks of `side`; none if no block has enough values."""
    factors = []
    for a, s in ((d, sigma), (d.T, sigma.T)):
        rows, n = a.shape[0], a.shape[1] - 3 * step
        if n < side:
            continue
        # Strips of a grid of more than 4 million values are sampled: a quantile of its thousands of
        # blocks needs no more.
        row_step = side * max(1, round(a.size / 4_000_000))
        full = [
            robust_factor(block)
            for first in range(0, rows, row_step)
            for block in _blocks(a[first : first + side], s[first : first + side], step, side)
        ]
        if full:
            factors.append(float(np.quantile(full, quantile)))
    return factors


def missing_sigma(
    d: Float[np.ndarray, "rows columns"],
    sigma: Float[np.ndarray, "rows columns"],
    unit: Float[np.ndarray, "rows columns"],
    step: int,
    side: int,
    quantile: float,
) -> float | None:
    """The s for which the variances σ² + (s·unit)² of values on a grid agree with their scatter; 0
    if σ² alone is enough, None if no block has enough values."""

    def excess(s: float) -> float:
        # The smoother of both directions: the other may contain the shape of the surface.
        factors = scatter_factor(d, np.hypot(sigma, s * unit), step, side, quantile)
        return min(factors, default=np.nan) - 1

    without = excess(0.0)
    if np.isnan(without):
        return None
    if without <= 0:
        return 0.0
    # One unit (a pixel) at most: a scatter above it is that of the surface, and matches of such σ
    # are rejected in any case.
    largest = 1.0
    if excess(largest) >= 0:
        return largest
    return float(brentq(excess, 0.0, largest))


def _blocks(
    a: Float[np.ndarray, "rows columns"], s: Float[np.ndarray, "rows columns"], step: int, side: int
) -> list[Float[np.ndarray, "rows side"]]:
    """Third differences over their σ along some rows, in blocks of `side` columns with enough known
    values."""
    n = a.shape[1] - 3 * step
    # Third differences: those of a quadratic surface are 0.
    parts = [(w, slice(k * step, k * step + n)) for k, w in enumerate((1.0, -3.0, 3.0, -1.0))]
    difference = sum(w * a[:, part] for w, part in parts)
    square = sum(w * w * s[:, part] ** 2 for w, part in parts)
    with np.errstate(invalid="ignore", divide="ignore"):
        ratio = difference / np.sqrt(square)
    blocks = (ratio[:, begin : begin + side] for begin in range(0, n, side))
    # A block of which two thirds are missing lies across the edge of a surface.
    return [b for b in blocks if np.isfinite(b).sum() > max(MIN_VALUES, side**2 / 3)]
