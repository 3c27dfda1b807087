"""Contradictory pairs: orientations around three photographs must close.

For photographs i, j, k, each two of which are a pair with M and a base b of length 1,

    M_jk·M_ij = M_ik,        β_ij·b_ij + β_jk·M_ijᵀ·b_jk = β_ik·b_ik

with the lengths β of the bases; their ratios follow from the depths of features common to two
pairs (a depth s of a pair is s·β). Without such features b_ik must still lie between b_ij and
M_ijᵀ·b_jk. A row of windows matched one window further keeps the rotation, and moves the camera:
only the bases do not close.

Pairs are accepted one after another, sure ones first, and among these those with many matches and
closing loops. A pair that contradicts accepted pairs in more loops than it agrees with is
left out. A pair that alone connects photographs has no loop: it stays, unless it is not sure
and its photographs are already connected: any two photographs of a long row of windows match, even
distant ones as if they were neighbours, and such pairs are consistent.

A photograph with most of its pairs left out shows mostly moving or repeated objects, and its other
pairs may show them unnoticed: only those with at least half the matches of its best pair stay.

Zach, Klopschitz and Pollefeys (2010), Disambiguating visual relations using loop constraints.
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from jaxbundle.tiepoints.verification import Pair, rotation_angle

TURN, GAP = np.radians(5.0), 0.15
"""Maximum rotation remaining around a loop, and gap of the bases relative to the longest."""
ASIDE, NARROW = 0.5, 0.03
"""Maximum distance of a base of unknown length from the angle between the two others; and angle of
intersection, radians, below which its direction is uncertain."""
ACCEPTED_SHARE = 1 / 3
"""Share of accepted pairs of a photograph below which only its best are used."""
FEWEST_COMMON = 8
"""Minimum common features of two pairs for the ratio of their bases."""
MOST_LOOPS = 12
"""Maximum loops examined per pair, those with the most matches."""


def split_contradicted(
    pairs: Sequence[Pair], ideal: Sequence[Float[np.ndarray, "_ 2"]]
) -> tuple[list[Pair], list[Pair]]:
    """Consistent pairs, and contradictory ones, in the given order.

    **Arguments:** `ideal`: coordinates of the features of every photograph, c = 1.
    """
    loops = _Loops(pairs, ideal)
    votes = {of: [loops.closes(of, k) for k in loops.thirds(of)] for of in loops.pairs}

    def strength(pair: Pair):
        of = votes.get(pair.images, [])
        good, bad = of.count(True), of.count(False)
        return pair.sure, len(pair) * (1 + good) / (1 + good + bad)

    taken: set[tuple[int, int]] = set()
    group = {k: k for pair in pairs for k in pair.images}
    for pair in sorted(pairs, key=strength, reverse=True):
        i, j = pair.images
        found = [
            loops.closes((i, j), k)
            for k in loops.thirds((i, j))
            if {_pair(i, k), _pair(j, k)} <= taken
        ]
        needed = pair.sure or group[i] != group[j]
        if found.count(False) <= found.count(True) and (needed or any(found)):
            taken.add((i, j))
            group = {k: group[i] if g == group[j] else g for k, g in group.items()}
    taken = _without_weak(pairs, taken)
    return ([p for p in pairs if p.images in taken], [p for p in pairs if p.images not in taken])


def _without_weak(pairs: Sequence[Pair], taken: set[tuple[int, int]]) -> set[tuple[int, int]]:
    """The accepted pairs without the weaker ones of photographs most of whose pairs contradict
    others; a pair that alone connects photographs stays."""
    weak = []
    for k in {k for pair in pairs for k in pair.images}:
        of = [p for p in pairs if k in p.images]
        left = [p for p in of if p.images in taken]
        if len(left) < ACCEPTED_SHARE * len(of):
            most = max(map(len, left), default=0)
            weak += [p for p in left if 2 * len(p) < most]
    for pair in sorted(weak, key=len):
        others = taken - {pair.images}
        if _are_connected(others, *pair.images):
            taken = others
    return taken


def _are_connected(pairs: set[tuple[int, int]], i: int, j: int) -> bool:
    """Whether a chain of pairs leads from a photograph to another."""
    reached, before = {i}, set()
    while reached != before and j not in reached:
        before = reached
        reached = before | {k for pair in pairs if before & {*pair} for k in pair}
    return j in reached


def _pair(i: int, j: int) -> tuple[int, int]:
    return min(i, j), max(i, j)


class _Loops:
    """Loops of pairs with a base."""

    def __init__(self, pairs: Sequence[Pair], ideal):
        self.pairs = {p.images: p for p in pairs if p.kind != "rotation"}
        self.depth = {p.images: _depths(p, ideal) for p in self.pairs.values()}
        self.next: dict[int, set[int]] = {}
        for i, j in self.pairs:
            self.next.setdefault(i, set()).add(j)
            self.next.setdefault(j, set()).add(i)
        self.known: dict[tuple[int, ...], bool | None] = {}

    def thirds(self, of: tuple[int, int]) -> list[int]:
        """Photographs that form a pair with both, those with the most matches first."""
        if of not in self.pairs:
            return []
        i, j = of
        fewest = lambda k: min(len(self.pairs[_pair(i, k)]), len(self.pairs[_pair(j, k)]))
        return sorted(self.next[i] & self.next[j], key=lambda k: (-fewest(k), k))[:MOST_LOOPS]

    def closes(self, of: tuple[int, int], k: int) -> bool | None:
        """Whether a loop closes; None if the bases are unknown."""
        loop = tuple(sorted((*of, k)))
        if loop not in self.known:
            self.known[loop] = self._closes(*loop)
        return self.known[loop]

    def _closes(self, i, j, k):
        ij, jk, ik = (self.pairs[of] for of in ((i, j), (j, k), (i, k)))
        turn = jk.M @ ij.M @ ik.M.T
        if rotation_angle(turn) > TURN:
            return False
        # ln β of jk and ik, β of ij is 1
        at_j, at_i = self._ratio((i, j), (j, k), 1, 0), self._ratio((i, j), (i, k), 0, 0)
        at_k = self._ratio((j, k), (i, k), 1, 1)
        if np.isnan([at_j, at_i, at_k]).sum() > 1:
            between = _is_between(ij.b, ij.M.T @ jk.b, ik.b)
            return None if between or ik.angle < NARROW else False
        of_jk = at_i - at_k if np.isnan(at_j) else at_j
        of_ik = at_j + at_k if np.isnan(at_i) else at_i
        second, third = np.exp(of_jk) * ij.M.T @ jk.b, np.exp(of_ik) * ik.b
        gap = np.linalg.norm(ij.b + second - third)
        return bool(gap < GAP * max(1.0, np.exp(of_jk), np.exp(of_ik)))

    def _ratio(self, one, other, of_one, of_other) -> float:
        """ln of the ratio of the base of `other` to that of `one`, by the depths in their common
        photograph: the first or second (0, 1) of each; NaN: unknown."""
        a, depth = self.pairs[one].matches[:, of_one], self.depth[one][of_one]
        b, far = self.pairs[other].matches[:, of_other], self.depth[other][of_other]
        _, rows, columns = np.intersect1d(a, b, return_indices=True)
        ratio = depth[rows] / far[columns]
        ratio = ratio[np.isfinite(ratio) & (ratio > 0)]
        return float(np.log(np.median(ratio))) if len(ratio) >= FEWEST_COMMON else np.nan


def _is_between(one, other, b) -> bool:
    """Whether a direction is a sum of two others with positive factors, to `ASIDE`."""
    from scipy.optimize import nnls

    factors, miss = nnls(np.stack([one, other], 1), b)
    return bool(miss < ASIDE and factors.any())


def _depths(pair: Pair, ideal):
    """Depths of the matches in both photographs for base 1."""
    a, c = (
        np.pad(ideal[k][rows], ((0, 0), (0, 1)), constant_values=-1.0)
        for k, rows in zip(pair.images, pair.matches.T)
    )
    c = c @ pair.M
    aa, cc, dot = (a**2).sum(1), (c**2).sum(1), (a * c).sum(1)
    determinant = aa * cc - dot * dot
    with np.errstate(divide="ignore", invalid="ignore"):
        return (
            (cc * (a @ pair.b) - dot * (c @ pair.b)) / determinant,
            (dot * (a @ pair.b) - aa * (c @ pair.b)) / determinant,
        )
