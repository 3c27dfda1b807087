"""Control points that fit a model only if an axis of theirs is reversed, or in another unit.

A similarity takes a model to control, whatever its scale: an error of all points that it cannot
take shows in their misfit alone, which then vanishes if the error is undone.
"""

import numpy as np
from jaxtyping import Float

from jaxbundle.network.units import METRES
from jaxbundle.orientation.alignment import similarity
from jaxbundle.orientation.settings import DEFAULTS, StartValueSettings

TWO_UNITS = "X, Y and Z have different units; give all of them in one"
# By the factors of the axes with which control fits: how it fits, and what to correct.
MISTAKES = {
    (-1.0, 1.0, 1.0): (
        "as a mirror image",
        "X and Y are exchanged, or one of X, Y, Z has the wrong sign, or the image coordinates "
        "count y downward; reverse one axis",
    ),
    (1.0, 1.0, METRES["ft"]): ("with heights in feet", TWO_UNITS),
    (1.0, 1.0, 1 / METRES["ft"]): ("with X and Y in feet", TWO_UNITS),
}


def describe_wrong_axes(
    source: Float[np.ndarray, "n 3"],
    target: Float[np.ndarray, "n 3"],
    unit: str,
    settings: StartValueSettings = DEFAULTS,
    times_better: float | None = None,
) -> str:
    """The mistake of `MISTAKES` without which control points (`target`) fit a model (`source`) so
    many times better (default: `settings.refused_axes`), in words; empty if there is none, or if
    undecidable (fewer than four points, or points in a plane that a mistake leaves as it is)."""
    if len(source) < 4:  # a triangle turned over is its own mirror image
        return ""
    plain = _misfit(source, target)
    misfits = {axes: _misfit(source, target * axes) for axes in MISTAKES}
    axes = min(misfits, key=misfits.__getitem__)
    extent = float(np.ptp(target, axis=0).max())
    ratio = settings.refused_axes if times_better is None else times_better
    if not misfits[axes] < min(plain / ratio, extent / settings.extent_to_misfit):
        return ""
    how, remedy = MISTAKES[axes]
    return (
        f"the {len(source)} control points fit the images better {how} (by {misfits[axes]:.3g} "
        f"{unit} instead of {plain:.3g}): {remedy}"
    )


def _misfit(source: Float[np.ndarray, "n 3"], target: Float[np.ndarray, "n 3"]) -> float:
    """The median distance of points after the similarity that takes one list to the other."""
    transformation = similarity(source, target)
    if transformation is None:
        return np.inf
    A, t = transformation
    return float(np.median(np.linalg.norm(source @ A.T + t - target, axis=1)))
