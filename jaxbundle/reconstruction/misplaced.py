"""Photographs whose start values contradict the relative orientations of most of their pairs.

Around a photograph that repeated parts of an object place wrongly, enough points agree: those along
epipolar lines. But its pairs were oriented, and closed in triplets, without this model.
"""

from collections import Counter
from collections.abc import Mapping

import numpy as np

from jaxbundle.network.tables import Network
from jaxbundle.orientation import many
from jaxbundle.tiepoints.verification import Pair, rotation_angle

TURN, ASIDE = np.radians(10.0), np.radians(30.0)
"""Maximum difference of rotations, and of base directions, that agree: start values are coarse."""
SURE_BASE = 0.03
"""Angle of intersection, radians, above which the direction of a base is known."""
FEWEST = 3
"""Minimum number of pairs for a photograph to be judged by them."""

NamedPairs = Mapping[tuple[str, str], Pair]
"""Pairs by the ids of their images."""


def find_misplaced(network: Network, pairs: NamedPairs) -> dict[str, str]:
    """Images that contradict more than half of their pairs, with the reason; the worst first,
    whose pairs no longer count for the others. None if these are most images: then it is not known
    which of them are right."""
    contradicted = _compare(network, pairs)
    found: dict[str, str] = {}
    while True:
        number = Counter(id for pair in contradicted for id in pair)
        bad = Counter(id for pair, wrong in contradicted.items() if wrong for id in pair)
        judged = [id for id in bad if number[id] >= FEWEST and 2 * bad[id] > number[id]]
        if not judged:
            return found if 2 * len(found) < len(network.images) else {}
        worst = max(judged, key=lambda id: bad[id] / number[id])
        found[worst] = (
            f"its position or attitude contradicts {bad[worst]} of its {number[worst]} pairs"
        )
        contradicted = {pair: wrong for pair, wrong in contradicted.items() if worst not in pair}


def _compare(network: Network, pairs: NamedPairs) -> dict[tuple[str, str], bool]:
    """Whether each pair contradicts the images."""
    row = {id: k for k, id in enumerate(network.images.id)}
    if not row:
        return {}
    X0, M = network.images.position, np.asarray(many.matrices(network.images.angles))
    found = {}
    for ids, pair in pairs.items():
        if ids[0] in row and ids[1] in row:
            i, j = (row[id] for id in ids)
            turned = rotation_angle(pair.M @ (M[j] @ M[i].T).T) > TURN
            base = M[i] @ (X0[j] - X0[i])
            aside = _angle(base, pair.b) > ASIDE
            clear = pair.kind != "rotation" and pair.angle > SURE_BASE
            found[ids] = bool(turned or (clear and aside))
    return found


def _angle(a, b) -> float:
    return float(np.arctan2(np.linalg.norm(np.cross(a, b)), a @ b))
