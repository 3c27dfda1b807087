"""Features of two photographs that look alike: each the nearest of the other, clearly so.

Descriptors of SIFT count as the roots of their parts of the sum (Arandjelović and Zisserman, 2012):
of unit length, so that their distance is √(2 − 2·a·b): one matrix product for all pairs.
A match is kept if it is the best from both sides, and if its distance is below `ratio` times that
of the second best (Lowe, 2004), of either side, and of what looks most like either of the two in
its own photograph: of identical windows the wrong one is as good as the right one.

Windows seen at other angles are not quite identical, and one may look more like another window of
the second photograph, seen at the same angle, than like itself. So a match says as well whether it
is `single`: whether nothing in either photograph looks like it as much as two photographs of one
place usually do.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxbundle.photographs.opencv import need_opencv
from jaxbundle.tiepoints.features import Features

RATIO = 0.8
PORTION = 1024
"""Features whose distances to all others are computed at once."""
OF_SIFT = 128
"""Numbers of a descriptor of SIFT."""
SAME = 1e-3
"""Descriptors whose distance is below this are the same."""
REPEATED = 0.22
"""Distance below which two features of a photograph may be of one kind of thing: that of most true
matches of SIFT."""
FEW = 800
"""Largest features by which is decided whether two photographs may show the same."""


class Matches(NamedTuple):
    """Rows of the features of two photographs that match, the clearest first; their clarity; which
    of them are of something that is in the photographs once."""

    images: tuple[int, int]
    rows: Int[np.ndarray, "n 2"]
    clarity: Float[np.ndarray, " n"]
    single: Bool[np.ndarray, " n"]

    def take(self, chosen) -> "Matches":
        """The chosen matches."""
        return Matches(
            self.images, self.rows[chosen], self.clarity[chosen], self.single[chosen]
        )


def match_features(
    one: Features,
    other: Features,
    ratio: float = RATIO,
    own: tuple[Float[np.ndarray, " a"], Float[np.ndarray, " b"]] | None = None,
) -> tuple[Int[np.ndarray, "n 2"], Float[np.ndarray, " n"]]:
    """Rows of features that match, the clearest first, and the ratio of their distances to those of
    the second best.

    **Arguments:** `own`: `distances_within` both photographs."""
    if min(len(one), len(other)) < 2 or one.descriptor.shape[1] != other.descriptor.shape[1]:
        return np.zeros((0, 2), int), np.zeros(0)
    sift = one.descriptor.shape[1] == OF_SIFT
    nearest = _nearest if sift else _nearest_bits
    a, b = (_root(f.descriptor) if sift else f.descriptor for f in (one, other))
    best, distance, second = nearest(a, b)
    if own is not None:
        second = np.minimum(second, np.minimum(own[0], own[1][best]))
    rows = np.flatnonzero(distance < ratio * second)
    if not len(rows):
        return np.zeros((0, 2), int), np.zeros(0)
    back, _, third = nearest(b[best[rows]], a)
    clarity = distance[rows] / np.maximum(np.minimum(second[rows], third), SAME)
    kept = np.flatnonzero((back == rows) & (clarity < ratio))
    kept = kept[np.argsort(clarity[kept], kind="stable")]
    rows = rows[kept]
    return np.stack([rows, best[rows]], 1), clarity[kept]


def single_matches(
    rows: Int[np.ndarray, "n 2"],
    own: tuple[Float[np.ndarray, " a"], Float[np.ndarray, " b"]],
) -> Bool[np.ndarray, " n"]:
    """Which matches are of something that nothing else in either photograph looks like."""
    return np.minimum(own[0][rows[:, 0]], own[1][rows[:, 1]]) >= REPEATED


def number_alike(one: Features, other: Features) -> int:
    """How many of the largest features match: a quick answer to whether two photographs overlap
    (Wu, 2013, preemptive matching)."""
    return len(match_features(one.take(slice(FEW)), other.take(slice(FEW)))[0])


def _root(descriptor):
    counts = descriptor.astype(np.float32)
    return np.sqrt(counts / np.maximum(counts.sum(1, keepdims=True), 1e-9))


def distances_within(features: Features) -> Float[np.ndarray, " n"]:
    """Of every feature the distance to what looks most like it elsewhere in its photograph; of bits
    infinite."""
    n = len(features)
    found = np.full(n, np.inf)
    if n < 2 or features.descriptor.shape[1] != OF_SIFT:
        return found
    a, xy = _root(features.descriptor), features.xy.astype(np.float32)
    near = features.size.astype(np.float32) ** 2
    for first in range(0, n, PORTION):
        rows = slice(first, first + PORTION)
        s = a[rows] @ a.T
        away = (xy[rows, None, 0] - xy[:, 0]) ** 2 + (xy[rows, None, 1] - xy[:, 1]) ** 2
        s[away <= near[rows, None]] = -1
        found[rows] = _distance(s.max(1))
    return found


def _nearest(a, b):
    """The nearest of b for each of a, its distance, and that of the second."""
    best, distance, second = np.empty(len(a), int), np.empty(len(a)), np.empty(len(a))
    for first in range(0, len(a), PORTION):
        s = a[first : first + PORTION] @ b.T
        rows, every = slice(first, first + len(s)), np.arange(len(s))
        k = s.argmax(1)
        best[rows], distance[rows] = k, _distance(s[every, k])
        s[every, k] = -1
        second[rows] = _distance(s.max(1))
    return best, distance, second


def _distance(product):
    return np.sqrt(np.maximum(1 - product, 0))


def _nearest_bits(a, b):
    cv2 = need_opencv()
    pairs = cv2.BFMatcher(cv2.NORM_HAMMING).knnMatch(a, b, k=2)
    best = np.array([p[0].trainIdx for p in pairs], int)
    return best, *(np.array([float(p[k].distance) for p in pairs]) for k in (0, 1))
