"""Weaknesses of a calibration in words, and advice on further photographs."""

from collections.abc import Iterator

import numpy as np
from jaxtyping import Float

from jaxbundle.calibration.quality import Coverage, CrossValidation
from jaxbundle.cameras import CameraModel
from jaxbundle.leastsquares.quality.weakness import VAGUE_RATIO

FEW_VIEWS = 8
SMALLEST_ROLL = 60.0
"""Minimum difference of roll between two photographs, degrees; 90 is best."""
SMALLEST_TILT = 15.0
"""Minimum angle between line of sight and board normal, degrees."""
FEW_TILTED = 3
RANGE = 1.3
"""Minimum ratio of farthest to nearest distance of the board."""
REACH, PART = 0.85, 0.6
LARGEST_RMS = 1.0
"""A larger RMS, in pixels, is not caused by corner detection."""
LARGEST_TEST = 3.0
SMALLEST_T = 1.0
"""A distortion coefficient with smaller |value|/σ is insignificant."""


def advice(
    position: Float[np.ndarray, "views 3"],
    rotation: Float[np.ndarray, "views 3 3"],
    middle: Float[np.ndarray, "3"],
    unit: str,
    covered: Coverage,
    rms: float,
    t: dict[str, float],
    model: CameraModel,
    validation: CrossValidation | None = None,
) -> list[str]:
    """Warnings in words, the most serious first; empty if there are none.

    **Arguments:** X0 and M of the views of a board in the plane Z = const, whose centre is
    `middle`; `covered`; `rms` of the residuals in pixels; `t` = |value|/σ by parameter of
    the `model`.
    """
    found = [
        f"{name} is known only to {100 / max(t[name], 1e-9):.0f} %: the photographs do not "
        "determine the principal distance; they need varied tilts and distances"
        for name in model.principal_distance
        if t.get(name, np.inf) < VAGUE_RATIO
    ]
    found += [*_geometry(position, rotation, middle, unit), *_image(covered)]
    if rms > LARGEST_RMS:
        found.append(
            f"the residuals are large (RMS {rms:.2f} px): look for blur, movement, a bent "
            "board (--board-sigma), or free more parameters"
        )
    if validation is not None and validation.test > LARGEST_TEST:
        found.append(
            f"the two halves of the photographs contradict each other (test {validation.test:.1f}, "
            "1 expected): the σ are too small; the camera may have changed (focus, zoom), or the "
            "model or the board does not fit (--model, --board-sigma)"
        )
    return found


def suggest(t: dict[str, float], model: CameraModel) -> list[str]:
    """Suggestions in words, for a calibration that may be good as it is."""
    weak = [name for name, value in t.items() if value < SMALLEST_T and name not in model.core]
    if not weak or model.prior:
        return []
    return [
        f"not significant: {', '.join(f'{n} (t {t[n]:.1f})' for n in weak)}; without "
        f"{'it' if len(weak) == 1 else 'them'} (--free) the others are better determined"
    ]


def turns(rotation: Float[np.ndarray, "views 3 3"]) -> Float[np.ndarray, " views"]:
    """The roll of every photograph about its line of sight, degrees: of the image's x axis in the
    plane of the board."""
    return np.degrees(np.arctan2(rotation[:, 0, 1], rotation[:, 0, 0]))


def tilts(rotation: Float[np.ndarray, "views 3 3"]) -> Float[np.ndarray, " views"]:
    """The angle between every line of sight and the normal of the board, degrees."""
    return np.degrees(np.arccos(np.clip(np.abs(rotation[:, 2, 2]), 0, 1)))


def _geometry(position, rotation, middle, unit) -> Iterator[str]:
    number = len(position)
    if number < FEW_VIEWS:
        yield (
            f"only {number} photographs show the board: take {FEW_VIEWS} to 20, from different "
            "directions"
        )
    steep = (tilts(rotation) > SMALLEST_TILT).sum()
    if steep < FEW_TILTED:
        yield (
            f"only {steep} of {number} photographs look at the board from more than "
            f"{SMALLEST_TILT:.0f}° aside, fewer than {FEW_TILTED}: the principal distance "
            "can hardly be separated from the distance of the board; take some tilted by 20° to "
            "45°, to the left, to the right, up and down"
        )
    turn = turns(rotation)
    apart = np.abs(turn[:, None] - turn) % 180
    if np.minimum(apart, 180 - apart).max() < SMALLEST_ROLL:
        yield (
            "no photograph is rolled by 90° about the line of sight: only the tilts determine the "
            "principal point; take some with the camera rolled"
        )
    away = np.linalg.norm(position - middle, axis=1)
    if away.max() < RANGE * away.min():
        yield (
            f"all photographs are from nearly one distance ({away.min():.3g} to {away.max():.3g} "
            f"{unit}): take some nearer and some farther away"
        )


def _image(covered: Coverage) -> Iterator[str]:
    empty = [name for name, there in covered.corners.items() if not there]
    if empty:
        corners = f"{', '.join(empty)} corner{'s' if len(empty) > 1 else ''}"
        yield (
            f"no point in the {corners} of the image: the distortion there is extrapolated; "
            "photograph the board there"
        )
    elif covered.reach < REACH:
        yield (
            f"the points reach to {100 * covered.reach:.0f} % of the half diagonal: photograph the "
            "board closer to the corners"
        )
    if covered.part < PART:
        yield (
            f"points cover {100 * covered.part:.0f} % of the image: move the board about in it, or "
            "let it fill the image"
        )
