"""Features at the same pixel in photographs from different positions: a date or a
name written into them, dirt on the sensor, a part of the vehicle; and the background of an object
that turns in front of a fixed camera.

These features match in any two photographs, without motion. A match is still if
both features have the same position, size and direction. If the other matches of a pair have moved,
and hardly any by a small amount, the still ones are not on the object; their positions in three
photographs are marks, and matches at marks with a small motion are left out of all pairs.

A background may have most of the matches. Then the moved ones must have a relative orientation, and
not that of a camera that moves without turning: far objects are still to it.

Far objects with few matches are still as well, but those in front of them move by all amounts, and
photographs from one position are still everywhere: neither gives marks.
"""

import dataclasses
from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float

from jaxbundle.tiepoints.features import Features
from jaxbundle.tiepoints.matching import FeatureMatches
from jaxbundle.tiepoints.verification import VerificationSettings, agreeing_matches, verify_pairs

# Size of the photographs, column and row of a cell of a grid over them.
Cell = tuple[tuple[int, int], int, int]


@dataclasses.dataclass(frozen=True)
class MarkSettings:
    """Settings of the search for marks at the same pixels of photographs."""

    max_motion: float = 0.001
    """Maximum motion of a still feature, relative to the longer side: 2 pixels of a photograph
    reduced to 1800, a few σ of the position of a feature."""
    small_motion: float = 5.0
    """A small motion: below this multiple of it. Also the side of the cells in which marks are
    collected, so that a mark lies in one cell or its neighbours in every photograph."""
    max_size_ratio: float = 1.25
    """Maximum ratio of the sizes of equal features: SIFT has three sizes to an octave, 1.26 apart,
    and interpolates between them."""
    max_turn: float = 0.2
    """Maximum difference of the directions of equal features, radians: one of the 36 bins, 0.17, of
    the histogram in which SIFT finds a direction."""
    min_moved: int = 16
    """Minimum matches of a pair that have moved: as many as a pair needs to be oriented
    (`VerificationSettings.min_matches`). If fewer than the still ones, they must be oriented."""
    principal_distance: float = 1.2
    """Principal distance of this orientation, relative to the longer side: of a lens with a field
    of view of 45°. Objects that turn and far objects are told apart at a third to twice it, too
    (`tests/tiepoints`)."""
    max_translated_share: float = 0.5
    """Maximum matches that a translation alone explains, relative to those that agree with the
    orientation. Simulated, with a distortion of 20 pixels: at most 0.36 of an object that turns by
    17° to 69°, at least 0.94 of one that a camera passes. More: far objects are mistaken for a
    background; fewer: slow turntables have none."""
    translation_trials: int = 40
    """Number of pairs of matches for trial translations: with half of the matches right, all trials
    have a wrong match with a probability of 0.75⁴⁰ = 1e-5."""
    max_small_share: float = 0.4
    """Maximum matches with small motion, relative to the still ones. More: far objects seen by a
    camera that hardly turns are mistaken for marks; fewer: marks beside a nearly still background
    remain, and orient pairs of photographs that have only them in common."""
    min_photographs: int = 3
    """Minimum photographs of a mark: in two, a far object may be still by chance."""


def without_marks(
    matches: Sequence[FeatureMatches],
    features: Sequence[Features],
    sizes: Sequence[tuple[int, int]],
    settings: MarkSettings = MarkSettings(),
) -> tuple[list[FeatureMatches], int]:
    """The matches without those of marks, and the number of photographs with marks."""
    still_and_motion = [_find_still(m, features, sizes, settings) for m in matches]
    marked_pairs, backgrounds = [], []
    for k, (rows, motion) in enumerate(still_and_motion):
        number_moved = int((motion > 1).sum())
        number_little = int(((motion > 1) & (motion < settings.small_motion)).sum())
        number = int(rows.sum())
        if (
            number
            and number_moved >= settings.min_moved
            and number_little <= settings.max_small_share * number
        ):
            (marked_pairs if number_moved >= number else backgrounds).append(k)
    pairs_on_background = (
        [matches[k] for k in backgrounds],
        [still_and_motion[k] for k in backgrounds],
    )
    turns = _object_turns(*pairs_on_background, features, sizes, settings)
    marked_pairs += [k for k, object_turns in zip(backgrounds, turns) if object_turns]
    images_of_cell: dict[Cell, set[int]] = {}
    for k in marked_pairs:
        for cell in _cells(matches[k], features, sizes, still_and_motion[k][0], settings):
            images_of_cell.setdefault(cell, set()).update(matches[k].images)
    marks = {
        cell for cell, images in images_of_cell.items() if len(images) >= settings.min_photographs
    }
    if not marks:
        return list(matches), 0
    # A mark at the border of a cell falls into its neighbour in another photograph.
    near_cells = {
        (size, i + a, j + b) for size, i, j in marks for a in (-1, 0, 1) for b in (-1, 0, 1)
    }
    remaining, marked = [], set()
    for m, (_, motion) in zip(matches, still_and_motion):
        # Of other features of a mark as well, whose positions are worse.
        rows = motion < settings.small_motion
        drop = np.zeros(len(m.rows), bool)
        drop[rows] = [cell in near_cells for cell in _cells(m, features, sizes, rows, settings)]
        if drop.any():
            marked.update(m.images)
            m = m.take(~drop)
        remaining.append(m)
    return remaining, len(marked)


def _find_still(
    m: FeatureMatches,
    features: Sequence[Features],
    sizes: Sequence[tuple[int, int]],
    settings: MarkSettings,
) -> tuple[Bool[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """Which matches are still, and the motion of all, relative to the limit."""
    i, j = m.images
    if sizes[i] != sizes[j] or not len(m.rows):
        return np.zeros(len(m.rows), bool), np.full(len(m.rows), np.inf)
    a, b = features[i].take(m.rows[:, 0]), features[j].take(m.rows[:, 1])
    motion = np.linalg.norm(a.xy - b.xy, axis=1) / (settings.max_motion * max(sizes[i]))
    is_same = np.abs(np.log(a.size / b.size)) < np.log(settings.max_size_ratio)
    # The difference of two directions, in (−π, π].
    is_same &= np.abs(np.angle(np.exp(1j * (a.angle - b.angle)))) < settings.max_turn
    return is_same & (motion < 1), motion


def _object_turns(
    matches: Sequence[FeatureMatches],
    still_and_motion: Sequence[tuple[Bool[np.ndarray, " n"], Float[np.ndarray, " n"]]],
    features: Sequence[Features],
    sizes: Sequence[tuple[int, int]],
    settings: MarkSettings,
) -> list[bool]:
    """By pair, whether the matches that have moved are of one object that has turned."""
    moved_matches = [m.take(motion > 1) for m, (_, motion) in zip(matches, still_and_motion)]

    def ideal(m: FeatureMatches, side: int) -> Float[np.ndarray, "n 2"]:
        k = m.images[side]
        # From the middle of the photograph, y up; c = 1.
        middle, c = np.array(sizes[k]) / 2, settings.principal_distance * max(sizes[k])
        return (features[k].xy[m.rows[:, side]] - middle) * (1, -1) / c

    points_1, points_2 = ([ideal(m, side) for m in moved_matches] for side in (0, 1))
    verification = VerificationSettings(min_matches=settings.min_moved)
    tolerance = verification.tolerance / settings.principal_distance
    verified = verify_pairs(
        points_1,
        points_2,
        np.full(len(moved_matches), tolerance),
        [m.unique for m in moved_matches],
        verification,
    )
    # By a rotation alone the moved matches have no depth: wrong ones, or something that passes.
    return [
        pair is not None
        and pair.kind != "rotation"
        and _most_translated(
            a[pair.good], b[pair.good], verification.first_factor * tolerance, settings
        )
        < settings.max_translated_share
        for a, b, pair in zip(points_1, points_2, verified)
    ]


def _most_translated(
    xy1: Float[np.ndarray, "n 2"],
    xy2: Float[np.ndarray, "n 2"],
    tolerance: float,
    settings: MarkSettings,
) -> float:
    """The share of matches that the best of some trial translations explains."""
    rays_1, rays_2 = (np.pad(xy, ((0, 0), (0, 1)), constant_values=-1.0) for xy in (xy1, xy2))
    # A base is coplanar with both rays of a match, so it is normal to the normals of two matches.
    normals, share = np.cross(rays_1, rays_2), 0.0
    rng = np.random.default_rng(0)
    for _ in range(settings.translation_trials):
        base = np.cross(*normals[rng.choice(len(normals), 2, replace=False)])
        for b in (base, -base):
            agree = agreeing_matches(np.eye(3), b, xy1, xy2, tolerance)
            share = max(share, float(agree.mean()))
    return share


def _cells(
    m: FeatureMatches,
    features: Sequence[Features],
    sizes: Sequence[tuple[int, int]],
    rows: Bool[np.ndarray, " n"],
    settings: MarkSettings,
) -> list[Cell]:
    """The cells of some matches."""
    i = m.images[0]
    side = settings.small_motion * settings.max_motion * max(sizes[i])
    cells = np.floor(features[i].xy[m.rows[rows, 0]] / side).astype(int)
    return [(sizes[i], column, row) for column, row in cells.tolist()]
