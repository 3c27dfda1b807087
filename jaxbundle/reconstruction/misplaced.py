"""Photographs whose start values contradict the relative orientations of most of their pairs.

With a photograph that repeated parts of an object place wrongly, enough points still agree: those
along epipolar lines. But its pairs, oriented and closed in triplets without the start values of the
whole, contradict it.
"""

import dataclasses
from collections import Counter
from collections.abc import Mapping

import numpy as np

from jaxbundle.network.tables import Network
from jaxbundle.orientation import batched
from jaxbundle.tiepoints.pair_consistency import LoopSettings
from jaxbundle.tiepoints.verification import Pair, rotation_angle


@dataclasses.dataclass(frozen=True)
class MisplacedSettings:
    """Settings of the comparison of start values with pairs. Both are coarse, and what remains
    undetected is seen in the residuals: only gross contradictions count."""

    max_rotation: float = 2 * LoopSettings.max_rotation
    """Maximum difference of rotations that agree, radians: twice that of a closed loop."""
    max_base_angle: float = float(np.arcsin(LoopSettings.max_aside))
    """Maximum difference of base directions that agree, radians, as in loops without common
    features: 30 degrees."""
    sure_base: float = LoopSettings.narrow_angle
    """Angle of intersection, radians, above which the direction of a base is known, as in
    loops."""
    min_pairs: int = 3
    """Minimum number of pairs for a photograph to be judged by them: with fewer, the
    photograph at the other end may be the wrong one."""


# Pairs by the ids of their images.
NamedPairs = Mapping[tuple[str, str], Pair]


def find_misplaced(
    network: Network, pairs: NamedPairs, settings: MisplacedSettings = MisplacedSettings()
) -> dict[str, str]:
    """Images that contradict more than half of their pairs, with the reason; the worst first,
    whose pairs no longer count for the others. Empty if these are half of the images or more: then
    it is not known which of them are right."""
    contradicted = _compare(network, pairs, settings)
    misplaced: dict[str, str] = {}
    # One at a time: the pairs of a misplaced photograph make its neighbours look wrong, too.
    while True:
        number = Counter(id for pair in contradicted for id in pair)
        bad = Counter(id for pair, wrong in contradicted.items() if wrong for id in pair)
        judged = [id for id in bad if number[id] >= settings.min_pairs and 2 * bad[id] > number[id]]
        if not judged:
            return misplaced if 2 * len(misplaced) < len(network.images) else {}
        worst = max(judged, key=lambda id: bad[id] / number[id])
        misplaced[worst] = (
            f"its position or attitude contradicts {bad[worst]} of its {number[worst]} pairs"
        )
        contradicted = {pair: wrong for pair, wrong in contradicted.items() if worst not in pair}


def _compare(
    network: Network, pairs: NamedPairs, settings: MisplacedSettings
) -> dict[tuple[str, str], bool]:
    """Whether each pair contradicts the images."""
    row = {id: k for k, id in enumerate(network.images.id)}
    if not row:
        return {}
    X0, M = network.images.position, np.asarray(batched.matrices(network.images.angles))
    contradicted = {}
    for ids, pair in pairs.items():
        if ids[0] in row and ids[1] in row:
            i, j = (row[id] for id in ids)
            turned = rotation_angle(pair.M @ (M[j] @ M[i].T).T) > settings.max_rotation
            # In the system of the first camera, as the base of the pair.
            base = M[i] @ (X0[j] - X0[i])
            angle = np.arctan2(np.linalg.norm(np.cross(base, pair.b)), base @ pair.b)
            clear = pair.kind != "rotation" and pair.angle > settings.sure_base
            contradicted[ids] = bool(turned or (clear and angle > settings.max_base_angle))
    return contradicted
