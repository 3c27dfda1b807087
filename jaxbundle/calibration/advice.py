"""Weaknesses of a calibration in words, and advice on further photographs."""

import dataclasses
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence

import numpy as np
from jaxtyping import Bool, Float

from jaxbundle.calibration.quality import Coverage, CrossValidation
from jaxbundle.cameras import CameraModel
from jaxbundle.leastsquares.quality.weakness import VAGUE_RATIO
from jaxbundle.network.columns import list_some
from jaxbundle.report.lens_advice import RICHER


@dataclasses.dataclass(frozen=True)
class AdviceSettings:
    """Limits of what photographs of a board should be like; beyond them, advice is given.

    **Fields:**

    - `min_views`: photographs of the board. Each has 6 unknowns of its own; larger or smaller:
      advice comes earlier or later.
    - `min_roll`: difference of roll between two photographs, degrees; 90 is best: the principal
      point is then seen from two sides; at 60 a cos of ½ remains.
    - `min_tilt`, `min_tilted`: angle between line of sight and board normal, degrees, and the
      number of photographs that have it: the change of scale across the board, which separates
      the principal distance from the distance, grows with the sine of the angle.
    - `min_distance_ratio`: of farthest to nearest distance of the board.
    - `min_move`: a photograph whose station has moved by less than this part of the distance of the
      board, and that is turned by less than as many radians, repeats another one: its points are
      moved by about as much of the principal distance, and see the same places of the lens.
      `max_alike`: the largest part of such photographs. Half or double of either name the same
      sets of photographs in the examples.
    - `min_removed`: photographs in which snooping has removed the same point of the board: gross
      errors of detection strike a point twice by chance.
    - `max_view_ratio`: RMS of a photograph over the median of all. Four times the variance: of 12
      residuals chance gives it once in 10⁵, and boards have more.
    - `min_reach`, `min_part`: of the half diagonal to the farthest point; of the cells of the image
      with points. Beyond the farthest point the distortion is extrapolated by its highest power.
    - `max_rms`: a larger RMS, in pixels, is not caused by corner detection, which has a tenth.
    - `max_test`: of the two halves (1 expected, for k parameters with a σ of √(2/k)).
    - `min_t`: a distortion coefficient with smaller |value|/σ is insignificant: its
      error is larger than itself, and 0 would be nearer.
    """

    min_views: int = 8
    min_roll: float = 60.0
    min_tilt: float = 15.0
    min_tilted: int = 3
    min_distance_ratio: float = 1.3
    min_move: float = 0.02
    max_alike: float = 0.2
    min_removed: int = 4
    max_view_ratio: float = 2.0
    min_reach: float = 0.85
    min_part: float = 0.6
    max_rms: float = 1.0
    max_test: float = 3.0
    min_t: float = 1.0


ADVICE = AdviceSettings()


def advice(
    position: Float[np.ndarray, "views 3"],
    rotation: Float[np.ndarray, "views 3 3"],
    middle: Float[np.ndarray, "*views 3"],
    unit: str,
    covered: Coverage,
    rms: float,
    t: dict[str, float],
    model: CameraModel,
    validation: CrossValidation | None = None,
    settings: AdviceSettings = ADVICE,
) -> list[str]:
    """Warnings in words, the most serious first; empty if there are none.

    **Arguments:** X0 and M of the views of a board in the plane Z = const, whose centre is
    `middle`, of every view if there are several boards; `covered`: the part of the image with
    points; `rms` of the residuals in pixels; `t` = |value|/σ by parameter of the `model`;
    `validation`: by halves of the photographs.
    """
    warnings = [
        f"{name} is known only to {100 / max(t[name], 1e-9):.0f} %: the photographs do not "
        "determine the principal distance; they need varied tilts and distances"
        for name in model.principal_distance
        if t.get(name, np.inf) < VAGUE_RATIO
    ]
    warnings += [*_geometry(position, rotation, middle, unit, settings), *_image(covered, settings)]
    if rms > settings.max_rms:
        warnings.append(
            f"the residuals are large (RMS {rms:.2f} px): look for blur, movement, a bent "
            "board (--board-sigma), or another camera model (--models)"
        )
    if validation is not None and validation.test > settings.max_test:
        warnings.append(
            f"the two halves of the photographs contradict each other (test {validation.test:.1f}, "
            "1 expected): the σ are too small; the camera may have changed (focus, zoom), or the "
            "model or the board does not fit (--model, --board-sigma)"
        )
    return warnings


def suggest(
    t: dict[str, float], model: CameraModel, which: str, settings: AdviceSettings = ADVICE
) -> list[str]:
    """Suggestions in words, for a calibration that may be good as it is; `which` parameters the
    camera should have (`report.lens_advice`)."""
    if which == RICHER:
        return []
    weak = [name for name, value in t.items() if value < settings.min_t and name not in model.core]
    if not weak or model.prior:
        return []
    return [
        f"not significant: {', '.join(f'{n} (t {t[n]:.1f})' for n in weak)}; without "
        f"{'it' if len(weak) == 1 else 'them'} (--free) the others are better determined"
    ]


def often_removed(
    points: Iterable[str], views: int, settings: AdviceSettings = ADVICE
) -> list[str]:
    """Points of the board that were removed in many of the `views`, in words; `points`: of every
    image point that was removed."""
    often = [(n, name) for name, n in Counter(points).items() if n >= settings.min_removed]
    return [
        f"point {name} of the board was removed in {n} of {views} photographs: it is not where it "
        "is given; look at the print there, or estimate the points of the board (--board-free)"
        for n, name in sorted(often, reverse=True)
    ]


def misfitting_views(
    names: Sequence[str], rms: Float[np.ndarray, " views"], settings: AdviceSettings = ADVICE
) -> list[str]:
    """Photographs whose residuals are much larger than those of the others, in words."""
    ratio = rms / np.nanmedian(rms) if np.nanmedian(rms) > 0 else np.zeros(len(rms))
    places = np.flatnonzero(ratio > settings.max_view_ratio)
    if not len(places):
        return []
    places = places[np.argsort(-ratio[places])]
    listed = list_some([names[k] for k in places], 5)
    return [
        f"{listed}: residuals up to {ratio[places[0]]:.1f} times as large as in most photographs; "
        "another camera, another zoom or focus, or a movement? Leave out what is not of this camera"
    ]


def many_not_used(used: int, not_used: int) -> list[str]:
    """That more photographs are not used than are, in words."""
    if not_used <= used:
        return []
    return [
        f"{not_used} of {used + not_used} photographs are not used: is the board the one that they "
        "show (--kind, --board)?"
    ]


def turns(rotation: Float[np.ndarray, "views 3 3"]) -> Float[np.ndarray, " views"]:
    """The roll of every photograph about its line of sight, degrees: of the image's x axis in the
    plane of the board."""
    return np.degrees(np.arctan2(rotation[:, 0, 1], rotation[:, 0, 0]))


def tilts(rotation: Float[np.ndarray, "views 3 3"]) -> Float[np.ndarray, " views"]:
    """The angle between every line of sight and the normal of the board, degrees."""
    return np.degrees(np.arccos(np.clip(np.abs(rotation[:, 2, 2]), 0, 1)))


def repeated(
    position: Float[np.ndarray, "views 3"],
    rotation: Float[np.ndarray, "views 3 3"],
    distance: Float[np.ndarray, " views"],
    min_move: float,
) -> Bool[np.ndarray, " views"]:
    """Which photographs have nearly the pose of an earlier one that has not."""
    is_repeated = np.zeros(len(position), bool)
    for k in range(len(position)):
        earlier = np.flatnonzero(~is_repeated[:k])
        move = np.linalg.norm(position[earlier] - position[k], axis=1) / distance[k]
        # Of a small rotation by a, trace(R) = 1 + 2·cos(a).
        cosine = (np.einsum("nij,ij->n", rotation[earlier], rotation[k]) - 1) / 2
        turn = np.arccos(np.clip(cosine, -1, 1))
        is_repeated[k] = (np.maximum(move, turn) < min_move).any()
    return is_repeated


def _geometry(
    position: Float[np.ndarray, "views 3"],
    rotation: Float[np.ndarray, "views 3 3"],
    middle: Float[np.ndarray, "*views 3"],
    unit: str,
    settings: AdviceSettings,
) -> Iterator[str]:
    number = len(position)
    if number < settings.min_views:
        yield (
            f"only {number} photographs show the board: take {settings.min_views} to 20, from "
            "different directions"
        )
    steep = (tilts(rotation) > settings.min_tilt).sum()
    if steep < settings.min_tilted:
        yield (
            f"only {steep} of {number} photographs look at the board from more than "
            f"{settings.min_tilt:.0f}° aside, fewer than {settings.min_tilted}: the principal "
            "distance can hardly be separated from the distance of the board; take some tilted by "
            "20° to 45°, to the left, to the right, up and down"
        )
    turn = turns(rotation)
    difference_of_roll = np.abs(turn[:, None] - turn) % 180
    if np.minimum(difference_of_roll, 180 - difference_of_roll).max() < settings.min_roll:
        yield (
            "no photograph is rolled by 90° about the line of sight: only the tilts determine the "
            "principal point; take some with the camera rolled"
        )
    distance = np.linalg.norm(position - middle, axis=1)
    if distance.max() < settings.min_distance_ratio * distance.min():
        yield (
            f"all photographs are from nearly one distance ({distance.min():.3g} to "
            f"{distance.max():.3g} {unit}): take some nearer and some farther away"
        )
    number_repeated = repeated(position, rotation, distance, settings.min_move).sum()
    if number_repeated > settings.max_alike * number:
        yield (
            f"{number_repeated} of {number} photographs repeat the pose of another: they are no "
            "further geometry, and halves of the photographs agree too well; take them from other "
            "places"
        )


def _image(covered: Coverage, settings: AdviceSettings) -> Iterator[str]:
    empty = [name for name, is_covered in covered.corners.items() if not is_covered]
    if empty:
        corners = f"{', '.join(empty)} corner{'s' if len(empty) > 1 else ''}"
        yield (
            f"no point in the {corners} of the image: the distortion there is extrapolated; "
            "photograph the board there"
        )
    elif covered.reach < settings.min_reach:
        yield (
            f"the points reach to {100 * covered.reach:.0f} % of the half diagonal: photograph the "
            "board closer to the corners"
        )
    if covered.part < settings.min_part:
        yield (
            f"points cover {100 * covered.part:.0f} % of the image: move the board about in it, or "
            "let it fill the image"
        )
