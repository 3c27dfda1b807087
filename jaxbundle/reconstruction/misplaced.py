"""Photographs whose start values contradict the relative orientations of most of their pairs.

Around a photograph that repeated parts of an object place wrongly, enough points agree: those along
epipolar lines. But its pairs were oriented, and closed in triplets, without this model.
"""

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
"""Minimum number of pairs of a photograph that can be contradicted by them."""

NamedPairs = Mapping[tuple[str, str], Pair]
"""Pairs by the ids of their images."""


def find_misplaced(network: Network, pairs: NamedPairs) -> dict[str, str]:
    """Images that contradict more than half of their pairs, with the reason; the worst first,
    whose pairs no longer count for the others."""
    contradicted = _compare(network, pairs)
    found: dict[str, str] = {}
    while contradicted:
        of = {id: [bad for pair, bad in contradicted.items() if id in pair]
              for pair in contradicted for id in pair}  # fmt: skip
        worst = max(of, key=lambda id: sum(of[id]) / len(of[id]))
        number, bad = len(of[worst]), sum(of[worst])
        if number < FEWEST or 2 * bad <= number:
            break
        found[worst] = f"its position contradicts {bad} of its {number} pairs"
        contradicted = {pair: bad for pair, bad in contradicted.items() if worst not in pair}
    return found


def _compare(network: Network, pairs: NamedPairs) -> dict[tuple[str, str], bool]:
    """Whether each pair contradicts the images."""
    row = {id: k for k, id in enumerate(network.images.id)}
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
