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

from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Bool, Float

from jaxbundle.tiepoints.features import Features
from jaxbundle.tiepoints.matching import Matches

LARGEST_MOTION = 0.002
"""Maximum motion of a match, relative to the longer side: a base this short gives intersection
angles of a tenth of a degree. A match of a blurred photograph is as uncertain as a quarter of the
size of its feature, which is added."""
OF_FEATURE = 0.25
SAME = 0.9
"""Minimum share of the matches at the same place; the others are wrong."""
LEAST, OF_FEATURES = 30, 0.2
"""Minimum matches at the same place, and their share of the features of the photograph with fewer
of them: a date written into two photographs has fewer."""
SPREAD = 0.5
"""Minimum standard deviation of these matches, in both directions, relative to that of all
features."""


def find_duplicates(
    matches: Sequence[Matches], features: Sequence[Features], sizes: Sequence[tuple[int, int]]
) -> dict[int, tuple[int, int, int]]:
    """By photograph to leave out: the one that shows the same, matches at the same place, and all
    their matches."""
    same: dict[tuple[int, int], tuple[int, int]] = {}
    for m in matches:
        still = _count_still(m, features, sizes)
        if still:
            same[m.images] = still, len(m.rows)
    return _leave_out(same, [len(f) for f in features])


def _leave_out(
    same: Mapping[tuple[int, int], tuple[int, int]], number: Sequence[int]
) -> dict[int, tuple[int, int, int]]:
    """Every photograph that shows the same as a better one that stays."""
    found: dict[int, tuple[int, int, int]] = {}
    for k in sorted(range(len(number)), key=lambda k: (-number[k], k)):
        for pair, counted in same.items():
            if k in pair:
                other = pair[pair[0] == k]
                better = (-number[other], other) < (-number[k], k)
                if better and other not in found:
                    found[k] = other, *counted
                    break
    return found


def _count_still(m: Matches, features, sizes) -> int:
    """The number of matches at the same place; 0 if the photographs do not show the same."""
    fewer = min(len(features[k]) for k in m.images)
    needed = max(LEAST, OF_FEATURES * fewer)
    if len(m.rows) < needed:
        return 0
    i, j = m.images
    one, other = (_places(features[k].xy, sizes[k]) for k in (i, j))
    a, b = one[m.rows[:, 0]], other[m.rows[:, 1]]
    blur = [
        OF_FEATURE * features[k].size[rows] / max(sizes[k]) for k, rows in zip((i, j), m.rows.T)
    ]
    limit = LARGEST_MOTION + np.maximum(*blur)
    for turns in range(4):
        still = _are_still(a, b, sizes[i], limit, turns, sizes[j])
        number = int(still.sum())
        if number >= max(needed, SAME * len(still)) and all(
            np.all(some[still].std(0) > SPREAD * every.std(0))
            for some, every in ((a, one), (b, other))
        ):
            return number
    return 0


def _places(xy: Float[np.ndarray, "n 2"], size) -> Float[np.ndarray, "n 2"]:
    """Positions in a photograph, 0 to 1 in both directions."""
    return (xy + 0.5) / np.array(size)


def _are_still(a, b, size, limit, turns: int, other_size) -> Bool[np.ndarray, " n"]:
    """Which matches are at the same place, the second photograph turned by quarters."""
    if turns % 2:
        other_size = other_size[::-1]
    ratio = size[0] / size[1] * other_size[1] / other_size[0]
    if abs(np.log(ratio)) > 0.01:
        return np.zeros(len(a), bool)
    for _ in range(turns):
        b = np.stack([1 - b[:, 1], b[:, 0]], 1)
    return np.linalg.norm((a - b) * np.array(size) / max(size), axis=1) < limit
