"""Matching features of two photographs: mutually nearest and distinct.

Descriptors of SIFT are the square roots of their normalised counts (Arandjelović and Zisserman,
2012), of unit length, so that their distance is √(2 − 2·a·b): one matrix product for all pairs.
A match is kept if it is mutually the best, and if its distance is below `ratio` times that
of the second best (Lowe, 2004), from either side, and of the most similar feature in
the same photograph: of identical windows the wrong one is as good as the right one.

Windows seen at different angles are not identical, and one may be more similar to another window of
the second photograph, seen at the same angle, than to itself. So a match also has a flag
`single`: no feature in either photograph is as similar to it as two photographs of one
point usually are.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxbundle.photographs.opencv import need_opencv
from jaxbundle.tiepoints.features import Features

RATIO = 0.8
PORTION = 1024
"""Features processed at once for distances to all others."""
OF_SIFT = 128
"""Numbers of a descriptor of SIFT."""
EQUAL_DESCRIPTORS = 1e-3
"""Descriptors whose distance is below this are the same."""
REPEATED = 0.22
"""Distance below which two features of a photograph may be repetitions: that of most true
matches of SIFT."""
LARGEST_FEATURES = 800
"""Number of largest features that decide whether two photographs may overlap."""


class Matches(NamedTuple):
    """Rows of matching features of two photographs, the most distinct first; their clarity; and
    which are unique in the photographs."""

    images: tuple[int, int]
    rows: Int[np.ndarray, "n 2"]
    clarity: Float[np.ndarray, " n"]
    single: Bool[np.ndarray, " n"]

    def take(self, chosen) -> "Matches":
        """The chosen matches."""
        return Matches(self.images, self.rows[chosen], self.clarity[chosen], self.single[chosen])


def match_features(
    one: Features,
    other: Features,
    ratio: float = RATIO,
    own: tuple[Float[np.ndarray, " a"], Float[np.ndarray, " b"]] | None = None,
) -> tuple[Int[np.ndarray, "n 2"], Float[np.ndarray, " n"]]:
    """Rows of matching features, the most distinct first, and the ratio of their distances to those
    of the second best.

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
    clarity = distance[rows] / np.maximum(np.minimum(second[rows], third), EQUAL_DESCRIPTORS)
    kept = np.flatnonzero((back == rows) & (clarity < ratio))
    kept = kept[np.argsort(clarity[kept], kind="stable")]
    rows = rows[kept]
    return np.stack([rows, best[rows]], 1), clarity[kept]


def single_matches(
    rows: Int[np.ndarray, "n 2"],
    own: tuple[Float[np.ndarray, " a"], Float[np.ndarray, " b"]],
) -> Bool[np.ndarray, " n"]:
    """Which matches have no similar feature in either photograph."""
    return np.minimum(own[0][rows[:, 0]], own[1][rows[:, 1]]) >= REPEATED


def number_alike(one: Features, other: Features) -> int:
    """The number of matches of the largest features: a quick check whether two photographs overlap
    (Wu, 2013, preemptive matching)."""
    largest = slice(LARGEST_FEATURES)
    return len(match_features(one.take(largest), other.take(largest))[0])


def _root(descriptor):
    counts = descriptor.astype(np.float32)
    return np.sqrt(counts / np.maximum(counts.sum(1, keepdims=True), 1e-9))


def distances_within(features: Features) -> Float[np.ndarray, " n"]:
    """For every feature the distance to the most similar one elsewhere in its photograph; infinite
    for binary descriptors."""
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
    """The nearest row of b for each row of a, its distance, and that of the second."""
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
