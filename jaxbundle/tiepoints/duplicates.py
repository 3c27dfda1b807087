"""Photographs that show the same as another one: saved again, reduced, blurred, or taken from the
same place at once.

Nearly all matches of such a pair are at the same place of both photographs, all over them. Its rays
do not intersect, so it adds nothing to a network; but it would connect the two photographs more
strongly than any other pair, and the worse one would then lack the points that the better one has.
The photograph with fewer features is left out.

Photographs of a fixed camera in front of which the object turns are no duplicates: the matches of
the object move. Places are relative to the size of the photographs, which may also be turned by 90
degrees against each other (saved upright).
"""

import dataclasses
from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Bool, Float

from jaxbundle.tiepoints.features import Features
from jaxbundle.tiepoints.matching import FeatureMatches


@dataclasses.dataclass(frozen=True)
class DuplicateSettings:
    """Settings of the search for photographs that show the same."""

    max_motion: float = 0.002
    """Maximum motion of a match, relative to the longer side: a base this short gives intersection
    angles of a tenth of a degree (at a principal distance of the longer side)."""
    feature_share: float = 0.25
    """Motion allowed in addition, relative to the size of the feature: a match of a blurred
    photograph is that uncertain. Smaller: blurred copies stay; larger: so may frames of a slow
    video, whose features are large."""
    min_share: float = 0.9
    """Minimum share of the matches at the same place; the others are wrong. If an object moves in
    front of a fixed camera, its matches are more than the remaining tenth."""
    min_matches: int = 30
    """Minimum matches at the same place: a few are at the same place by chance."""
    min_feature_share: float = 0.2
    """Minimum matches at the same place relative to the features of the photograph with fewer
    of them: a date written into two photographs has fewer."""
    min_spread: float = 0.5
    """Minimum standard deviation of these matches, in both directions, relative to that of all
    features: a mark in a corner has less."""


def find_duplicates(
    matches: Sequence[FeatureMatches],
    features: Sequence[Features],
    sizes: Sequence[tuple[int, int]],
    settings: DuplicateSettings = DuplicateSettings(),
) -> dict[int, tuple[int, int, int]]:
    """By photograph to leave out: the one that shows the same, matches at the same place, and all
    their matches."""
    same_pairs: dict[tuple[int, int], tuple[int, int]] = {}
    for m in matches:
        number_still = _count_still(m, features, sizes, settings)
        if number_still:
            same_pairs[m.images] = number_still, len(m.rows)
    return _choose_left_out(same_pairs, [len(f) for f in features])


def _choose_left_out(
    same_pairs: Mapping[tuple[int, int], tuple[int, int]], number: Sequence[int]
) -> dict[int, tuple[int, int, int]]:
    """Every photograph that shows the same as a better one that stays."""
    left_out: dict[int, tuple[int, int, int]] = {}
    # The best first: whether it stays is known before those that it replaces are judged.
    for k in sorted(range(len(number)), key=lambda k: (-number[k], k)):
        for pair, counted in same_pairs.items():
            if k in pair:
                partner = pair[pair[0] == k]
                better = (-number[partner], partner) < (-number[k], k)
                if better and partner not in left_out:
                    left_out[k] = partner, *counted
                    break
    return left_out


def _count_still(
    m: FeatureMatches,
    features: Sequence[Features],
    sizes: Sequence[tuple[int, int]],
    settings: DuplicateSettings,
) -> int:
    """The number of matches at the same place; 0 if the photographs do not show the same."""
    fewer = min(len(features[k]) for k in m.images)
    needed = max(settings.min_matches, settings.min_feature_share * fewer)
    if len(m.rows) < needed:
        return 0
    i, j = m.images
    # Positions in a photograph, 0 to 1 in both directions.
    places_i, places_j = ((features[k].xy + 0.5) / np.array(sizes[k]) for k in (i, j))
    a, b = places_i[m.rows[:, 0]], places_j[m.rows[:, 1]]
    blur = [
        settings.feature_share * features[k].size[rows] / max(sizes[k])
        for k, rows in zip((i, j), m.rows.T)
    ]
    limit = settings.max_motion + np.maximum(*blur)
    # One of them may have been saved upright, in either direction, or upside down.
    for turns in range(4):
        is_still = _are_still(a, b, sizes[i], limit, turns, sizes[j])
        number = int(is_still.sum())
        if number >= max(needed, settings.min_share * len(is_still)) and all(
            np.all(in_match[is_still].std(0) > settings.min_spread * in_photograph.std(0))
            for in_match, in_photograph in ((a, places_i), (b, places_j))
        ):
            return number
    return 0


def _are_still(
    a: Float[np.ndarray, "n 2"],
    b: Float[np.ndarray, "n 2"],
    size: tuple[int, int],
    limit: Float[np.ndarray, " n"],
    turns: int,
    other_size: tuple[int, int],
) -> Bool[np.ndarray, " n"]:
    """Which matches are at the same place, the second photograph turned by quarters."""
    if turns % 2:
        other_size = other_size[1], other_size[0]
    ratio = size[0] / size[1] * other_size[1] / other_size[0]
    # 1 %: whole pixels of a reduced photograph; cropped ones do not show the same
    if abs(np.log(ratio)) > 0.01:
        return np.zeros(len(a), bool)
    for _ in range(turns):
        b = np.stack([1 - b[:, 1], b[:, 0]], 1)
    return np.linalg.norm((a - b) * np.array(size) / max(size), axis=1) < limit
