"""Contradictory pairs: orientations around three photographs must close.

For photographs i, j, k, each two of which are a pair with M and a base b of length 1,

    M_jk·M_ij = M_ik,        β_ij·b_ij + β_jk·M_ijᵀ·b_jk = β_ik·b_ik

with the lengths β of the bases; their ratios follow from the depths of features common to two
pairs (a depth s computed with a base of 1 is s·β in the object). Without such features b_ik must
still lie between b_ij and M_ijᵀ·b_jk. A row of windows matched one window further keeps the
rotation, and moves the camera: only the bases do not close.

Pairs are accepted one after another, sure ones first, and among these those with many matches and
closing loops. A pair that contradicts accepted pairs in more loops than it agrees with is
left out. One without loops stays, but one that is not sure only if nothing else connects its
photographs yet; otherwise a loop must confirm it: any two photographs of a long row of windows
match, even distant ones as if they were neighbours, and such pairs are consistent.

A photograph with most of its pairs left out shows mostly moving or repeated objects, and its other
pairs may show them unnoticed: only those with at least half the matches of its best pair stay.

Zach, Klopschitz and Pollefeys (2010), Disambiguating visual relations using loop constraints.
"""

import dataclasses
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from jaxbundle.tiepoints.pair_graph import label_connected
from jaxbundle.tiepoints.verification import Pair, depths_of_rays, loop_misclosure

# The photographs of a pair, the smaller number first.
PhotographPair = tuple[int, int]


@dataclasses.dataclass(frozen=True)
class LoopSettings:
    """Settings of the test of pairs around three photographs."""

    max_rotation: float = np.radians(5.0)
    """Maximum rotation remaining around a loop, radians: a principal distance 5 % wrong changes
    the rotation between views 30 degrees apart by 1.5 degrees, and three pairs add up. Larger:
    wrong pairs close."""
    max_gap: float = 0.15
    """Maximum gap of the bases, relative to the longest. Windows matched one further move a camera
    by their distance, which is seen if that is more than this part of the base; a smaller limit
    rejects right pairs whose ratios of bases rest on `min_common` features."""
    max_aside: float = 0.5
    """Maximum distance of a base (of length 1) from the sector between the directions of the two
    others, where their ratios are unknown: the sine of 30 degrees. Without common features only
    gross contradictions count."""
    narrow_angle: float = 0.03
    """Angle of intersection, radians (2 degrees), below which the direction of a base is
    uncertain."""
    accepted_share: float = 1 / 3
    """Share of accepted pairs of a photograph below which only its best are used. This rule and
    `max_aside` reduced the errors of the set `building`, where a car stands elsewhere in every
    photograph, from 1.3e-2 to 1.2e-3."""
    min_common: int = 8
    """Minimum common features of two pairs for the ratio of their bases, which is a median: up to
    three of eight may be wrong."""
    max_loops: int = 12
    """Maximum loops examined per pair, those with the most matches: bounds the time in blocks where
    everything overlaps; a vote of 12 is clear."""


def split_contradicted(
    pairs: Sequence[Pair],
    ideal: Sequence[Float[np.ndarray, "_ 2"]],
    settings: LoopSettings = LoopSettings(),
) -> tuple[list[Pair], list[Pair]]:
    """Consistent pairs, and contradictory ones, in the given order.

    **Arguments:** `ideal`: coordinates of the features of every photograph, c = 1.
    """
    loops = _Loops(pairs, ideal, settings)
    # First with all pairs, wrong ones included, which only orders them.
    votes = {ids: [loops.closes(ids, k) for k in loops.thirds(ids)] for ids in loops.pairs}

    def strength(pair: Pair) -> tuple[bool, float]:
        """Matches times the estimated probability that a loop closes, (good + 1)/(good + bad + 1):
        1 without loops, so that these do not count against a pair."""
        closures = votes.get(pair.images, [])
        good, bad = closures.count(True), closures.count(False)
        return pair.sure, len(pair) * (1 + good) / (1 + good + bad)

    # Greedy, the strongest first, like Kruskal's spanning tree: a wrong pair is then judged by
    # right ones, and wrong ones that agree with it do not count.
    accepted: set[PhotographPair] = set()
    group = {k: k for pair in pairs for k in pair.images}
    for pair in sorted(pairs, key=strength, reverse=True):
        i, j = pair.images
        closures = [
            loops.closes((i, j), k)
            for k in loops.thirds((i, j))
            if {_pair(i, k), _pair(j, k)} <= accepted
        ]
        # A pair by repeated features must be confirmed, unless nothing else connects its sides.
        needs_no_loop = pair.sure or group[i] != group[j]
        if closures.count(False) <= closures.count(True) and (needs_no_loop or any(closures)):
            accepted.add((i, j))
            group = {k: group[i] if g == group[j] else g for k, g in group.items()}
    accepted = _without_weak(pairs, accepted, settings.accepted_share)
    return (
        [p for p in pairs if p.images in accepted],
        [p for p in pairs if p.images not in accepted],
    )


def _without_weak(
    pairs: Sequence[Pair], accepted: set[PhotographPair], min_share: float
) -> set[PhotographPair]:
    """The accepted pairs without the weaker ones of photographs most of whose pairs contradict
    others; a pair that alone connects photographs stays."""
    weak = []
    for k in {k for pair in pairs for k in pair.images}:
        pairs_of_photograph = [p for p in pairs if k in p.images]
        accepted_pairs = [p for p in pairs_of_photograph if p.images in accepted]
        if len(accepted_pairs) < min_share * len(pairs_of_photograph):
            largest_number = max(map(len, accepted_pairs), default=0)
            weak += [p for p in accepted_pairs if 2 * len(p) < largest_number]
    number = max((k for pair in pairs for k in pair.images), default=0) + 1
    for pair in sorted(weak, key=len):
        other_pairs, (i, j) = accepted - {pair.images}, pair.images
        label = label_connected(number, other_pairs)
        if label[i] == label[j]:
            accepted = other_pairs
    return accepted


def _pair(i: int, j: int) -> PhotographPair:
    return min(i, j), max(i, j)


class _Loops:
    """Loops of pairs with a base."""

    def __init__(
        self,
        pairs: Sequence[Pair],
        ideal: Sequence[Float[np.ndarray, "_ 2"]],
        settings: LoopSettings,
    ):
        self.settings = settings
        self.pairs = {p.images: p for p in pairs if p.kind != "rotation"}
        self.depth = {p.images: _depths(p, ideal) for p in self.pairs.values()}
        self.neighbours: dict[int, set[int]] = {}
        for i, j in self.pairs:
            self.neighbours.setdefault(i, set()).add(j)
            self.neighbours.setdefault(j, set()).add(i)
        self.closed: dict[tuple[int, ...], bool | None] = {}

    def thirds(self, ids: PhotographPair) -> list[int]:
        """Photographs that form a pair with both, those with the most matches first."""
        if ids not in self.pairs:
            return []
        i, j = ids
        fewest = lambda k: min(len(self.pairs[_pair(i, k)]), len(self.pairs[_pair(j, k)]))
        common = sorted(self.neighbours[i] & self.neighbours[j], key=lambda k: (-fewest(k), k))
        return common[: self.settings.max_loops]

    def closes(self, ids: PhotographPair, k: int) -> bool | None:
        """Whether a loop closes; None if the bases are unknown."""
        loop = tuple(sorted((*ids, k)))
        if loop not in self.closed:
            self.closed[loop] = self._closes(*loop)
        return self.closed[loop]

    def _closes(self, i: int, j: int, k: int) -> bool | None:
        ij, jk, ik = (self.pairs[ids] for ids in ((i, j), (j, k), (i, k)))
        if loop_misclosure(ij.M, jk.M, ik.M) > self.settings.max_rotation:
            return False
        # ln β of jk and ik, β of ij is 1: each from the features that two pairs share in the
        # photograph that they share; two of the three ratios suffice
        at_j, at_i = self._ratio((i, j), (j, k), 1, 0), self._ratio((i, j), (i, k), 0, 0)
        at_k = self._ratio((j, k), (i, k), 1, 1)
        # Without two of them the bases can have any lengths: of the second equation only β > 0 is
        # left. If ik is narrow, its base may be the small difference of two opposite ones, of any
        # direction; if ij or jk is narrow, its base is short, and ik nearly has that of the other.
        if np.isnan([at_j, at_i, at_k]).sum() > 1:
            is_between = _is_between(ij.b, ij.M.T @ jk.b, ik.b, self.settings.max_aside)
            return None if is_between or ik.angle < self.settings.narrow_angle else False
        of_jk = at_i - at_k if np.isnan(at_j) else at_j
        of_ik = at_j + at_k if np.isnan(at_i) else at_i
        second_base, third_base = np.exp(of_jk) * ij.M.T @ jk.b, np.exp(of_ik) * ik.b
        gap = np.linalg.norm(ij.b + second_base - third_base)
        longest = max(1.0, np.exp(of_jk), np.exp(of_ik))
        return bool(gap < self.settings.max_gap * longest)

    def _ratio(
        self, pair_a: PhotographPair, pair_b: PhotographPair, of_one: int, of_other: int
    ) -> float:
        """ln of the ratio of the base of `pair_b` to that of `pair_a`, by the depths in their
        common photograph: the first or second (0, 1) of each; NaN: unknown."""
        a, depth = self.pairs[pair_a].matches[:, of_one], self.depth[pair_a][of_one]
        b, depth_b = self.pairs[pair_b].matches[:, of_other], self.depth[pair_b][of_other]
        _, rows, columns = np.intersect1d(a, b, return_indices=True)
        ratio = depth[rows] / depth_b[columns]
        ratio = ratio[np.isfinite(ratio) & (ratio > 0)]
        has_enough = len(ratio) >= self.settings.min_common
        return float(np.log(np.median(ratio))) if has_enough else np.nan


def _is_between(
    direction_a: Float[np.ndarray, "3"],
    direction_b: Float[np.ndarray, "3"],
    b: Float[np.ndarray, "3"],
    max_miss: float,
) -> bool:
    """Whether a direction is a sum of two others with positive factors, to a distance "
    "`max_miss`."""
    from scipy.optimize import nnls

    factors, miss = nnls(np.stack([direction_a, direction_b], 1), b)
    return bool(miss < max_miss and factors.any())


def _depths(
    pair: Pair, ideal: Sequence[Float[np.ndarray, "_ 2"]]
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """Depths of the matches in both photographs for base 1."""
    a, c = (
        np.pad(ideal[k][rows], ((0, 0), (0, 1)), constant_values=-1.0)
        for k, rows in zip(pair.images, pair.matches.T)
    )
    depth_1, depth_2, determinant = depths_of_rays(a, c @ pair.M, pair.b)
    with np.errstate(divide="ignore", invalid="ignore"):
        return depth_1 / determinant, depth_2 / determinant
