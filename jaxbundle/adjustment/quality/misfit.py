"""Comparison of σ0 and the median residual with the a priori σ.

A few blunders do not change the robust scale of the residuals (`leastsquares/quality/robust.py`),
too small σ do; σ0 is changed by both, which separates the two causes.
"""

from jaxbundle.leastsquares.quality.global_test import CONTRADICTING_RATIO, contradicts
from jaxbundle.report.verdict import most_removed


def doubt_of_baarda(
    scale: float, removed: int, rays: int, redundancy: int, significance: float
) -> str | None:
    """A message about Baarda's test with a priori σ that the data contradict, or with many more
    removed image points than chance explains, and the remedy.

    **Arguments:** `scale` of the good image points, without selection by this test; the number of
    removed points and of all; the level of the test, for one coordinate.
    """
    by_chance = 1 - (1 - significance) ** 2  # either of the two coordinates of a point
    took = (
        f"{removed} of {rays} image points removed, {100 * removed / rays:.2g} %; of good ones "
        f"significance {significance:g} removes {100 * by_chance:.2g} %"
    )
    pope = "test with the a posteriori σ (--snooping pope)"
    if contradicts(scale, redundancy):
        consequence = (
            "removed good observations with the blunders" if scale > 1 else "passed blunders"
        )
        return (
            f"Baarda's test trusts the a priori σ, but most residuals are {scale:.3g} times as "
            f"large as they imply: it has {consequence} ({took}). {_remedy(scale)}, or {pope}"
        )
    if removed > most_removed(rays, by_chance):
        return (
            f"Baarda's test has removed many observations ({took}): there are as many blunders, or "
            f"the a priori σ are a little too small. Look at what was removed, or {pope}"
        )
    return None


def doubt_of_robust(scale: float, redundancy: int) -> str | None:
    """A message that the scale of a robust estimate contradicts the given σ, and the remedy."""
    if not contradicts(scale, redundancy):
        return None
    return (
        f"the scale of the robust estimation, from the median of the residuals (MAD), is "
        f"{scale:.3g} times that of the a priori σ, which the data contradict; the weights do not "
        f"depend on them. {_remedy(scale)}"
    )


def doubt_of_fit(
    sigma0: float,
    scale: float,
    redundancy: int,
    in_pixels: bool = False,
    unrecognisable: float = 20.0,
) -> str | None:
    """A message that the global test clearly fails, with the ratio and the likely causes first.

    **Arguments:** `sigma0` of all observations; `scale` of the image points by their median;
    whether a principal distance in mm may be `in_pixels`; `unrecognisable`: residuals this many
    times their σ are most likely due to wrong axes or units. It only orders the causes: optimistic
    σ are seldom wrong by as much, an axis or a unit is wrong by the size of the image.
    """
    if not (redundancy > 0 and contradicts(sigma0, redundancy)):
        return None
    beginning = (
        f"χ² test clearly failed: vᵀPv/redundancy is {sigma0**2:.3g} (σ0 {sigma0:.3g}), not 1"
    )
    if sigma0 < 1:
        return f"{beginning}; likely cause: a priori σ that are too large. {_remedy(sigma0)}"
    sigma, blunders = "a priori σ that are too small", "blunders (--snooping pope)"
    missing_parameter = "a camera parameter that is missing or held"
    mirrored = "image coordinates with a mirrored axis or in another unit"
    # The median does not see a few blunders, σ0 does: a large σ0 of good residuals are blunders.
    # Half: blunders then make three quarters of the sum of squares.
    if scale < CONTRADICTING_RATIO or scale < sigma0 / 2:
        causes = [blunders, missing_parameter, sigma]
    elif scale > unrecognisable:
        causes = [mirrored, missing_parameter, sigma, blunders]
    else:
        sigma += f" (multiply them by {scale:.3g}, or --components)"
        causes = [sigma, blunders, missing_parameter, mirrored]
    if in_pixels:
        causes.insert(0, "a principal distance in pixels instead of mm")
    return f"{beginning}; likely causes, the likeliest first: {', '.join(causes)}"


def doubt_of_unit(sigma0: float, redundancy: int, unit: str) -> str | None:
    """A message that a `unit` of weight, which nobody stated, does not suit the σ of observations
    of other kinds, and the remedy."""
    if not (redundancy > 0 and contradicts(sigma0, redundancy)):
        return None
    return (
        f"no a priori σ of image coordinates was given: {unit} was assumed beside the σ of other "
        f"observations, but σ0 is {sigma0:.3g}, so the other observations are wrongly weighted: "
        "give sigma_image, or estimate it (--components)"
    )


def _remedy(scale: float) -> str:
    return (
        f"Multiply the a priori σ (sigma_image, or those of the observations) by {scale:.3g}, or "
        "estimate them (--components)"
    )
