"""Cameras of a batch that have a solution which does not fit, and what may be the reason.

A camera is a misfit by itself where few points make most of its vᵀv. The lengths of normal
residuals have √(mean of squares)/mean = 2/√π = 1.128; beyond `TAIL` times that they are not normal.
It is one beside the others where its RMS is above `FARTHER` times their median, and above it, in
the logarithm, by more than `DEVIATIONS` times their spread (1.4826 times the median deviation).
"""

import numpy as np
from jaxtyping import Bool, Float

TAIL = 1.5
"""1 for normal residuals, 1.2 for half the views five times as noisy as the others."""
NORMAL = 2 / np.sqrt(np.pi)
FARTHER, DEVIATIONS = 3.0, 5.0
FEWEST = 5
"""So many solved cameras are a population."""
NEGLIGIBLE = 0.01
"""An RMS below this is no misfit, pixels."""
OUTSIDE = 0.5
"""More than this part of the image points is outside the image: their axes are not those meant."""


def misfits(
    rms: Float[np.ndarray, " cameras"],
    mean_length: Float[np.ndarray, " cameras"],
    solved: Bool[np.ndarray, " cameras"],
) -> Bool[np.ndarray, " cameras"]:
    """Which solved cameras do not fit; `mean_length` of their residuals (pixels)."""
    found = np.zeros(len(rms), bool)
    candidates = np.flatnonzero(solved & (rms > NEGLIGIBLE))
    found[candidates] = rms[candidates] > TAIL * NORMAL * mean_length[candidates]
    if solved.sum() >= FEWEST:
        log = np.log(np.maximum(rms[solved], NEGLIGIBLE))
        middle = np.median(log)
        spread = 1.4826 * np.median(np.abs(log - middle))
        limit = np.exp(middle + max(np.log(FARTHER), DEVIATIONS * spread))
        found[candidates] |= rms[candidates] > limit
    return found


def axes_remark(
    xy: Float[np.ndarray, "points 2"], size: Float[np.ndarray, "2"], down: bool
) -> str:
    """What is odd about the axes of image points; empty where most of them are in the image.

    **Arguments:** `down`: y is counted downwards from the upper left pixel, else upwards from the
    middle.
    """
    low = np.full(2, -0.5) if down else -size / 2
    outside = (xy < low) | (xy > low + size)
    part = outside.any(1).mean() if len(xy) else 0.0
    if part <= OUTSIDE:
        return ""
    if not down and ((xy > -0.5) & (xy < size)).all(1).mean() > 0.9:
        return (
            "the image points seem to be counted from a corner of the image: in this model (0, 0) "
            "is its middle, and y goes up"
        )
    if not down:
        return f"{100 * part:.0f} % of the image points are outside the image"
    for axis, name in enumerate("xy"):
        negated = (xy[:, axis] < low[axis]) & (xy[:, axis] > -size[axis] - 0.5)
        if negated.mean() > 0.9:
            return f"the {name} axis of the image points seems to be negated: {name} < 0"
    if (np.abs(xy) <= size / 2 + 1).all(1).mean() > 0.9:
        return (
            "the image points seem to be counted from the middle of the image: (0, 0) is its upper "
            "left pixel"
        )
    return f"{100 * part:.0f} % of the image points are outside the image: is image_size right?"
