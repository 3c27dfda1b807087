"""Features of two photographs that look alike: each the nearest of the other, clearly so.

Descriptors of SIFT count as the roots of their parts of the sum (Arandjelović and Zisserman, 2012):
of unit length, so that their distance is √(2 − 2·a·b): one matrix product for all pairs.
A match is kept if it is the best from both sides and its distance is below `ratio` times that of
the second best (Lowe, 2004).
"""

import numpy as np
from jaxtyping import Float, Int

from jaxbundle.photographs.opencv import need_opencv
from jaxbundle.tiepoints.features import Features

RATIO = 0.8
PORTION = 1024
"""Features whose distances to all others are computed at once."""
OF_SIFT = 128
"""Numbers of a descriptor of SIFT."""
FEW = 800
"""Largest features by which is decided whether two photographs may show the same."""


def match_features(
    one: Features, other: Features, ratio: float = RATIO
) -> tuple[Int[np.ndarray, "n 2"], Float[np.ndarray, " n"]]:
    """Rows of features that match, the clearest first, and the ratio of their distances to those of
    the second best."""
    if min(len(one), len(other)) < 2 or one.descriptor.shape[1] != other.descriptor.shape[1]:
        return np.zeros((0, 2), int), np.zeros(0)
    sift = one.descriptor.shape[1] == OF_SIFT
    nearest = _nearest if sift else _nearest_bits
    a, b = (_root(f.descriptor) if sift else f.descriptor for f in (one, other))
    best, found = nearest(a, b)
    rows = np.flatnonzero(found < ratio)
    if not len(rows):
        return np.zeros((0, 2), int), np.zeros(0)
    back, _ = nearest(b[best[rows]], a)
    rows = rows[back == rows]
    rows = rows[np.argsort(found[rows], kind="stable")]
    return np.stack([rows, best[rows]], 1), found[rows]


def number_alike(one: Features, other: Features) -> int:
    """How many of the largest features match: a quick answer to whether two photographs overlap
    (Wu, 2013, preemptive matching)."""
    return len(match_features(one.take(slice(FEW)), other.take(slice(FEW)))[0])


def _root(descriptor):
    counts = descriptor.astype(np.float32)
    return np.sqrt(counts / np.maximum(counts.sum(1, keepdims=True), 1e-9))


def _nearest(a, b):
    """The nearest of b for each of a, and the ratio of its distance to that of the second."""
    best, ratio = np.empty(len(a), int), np.empty(len(a))
    for first in range(0, len(a), PORTION):
        s = a[first : first + PORTION] @ b.T
        every = np.arange(len(s))
        k = s.argmax(1)
        nearest = s[every, k]
        s[every, k] = -1
        second = s.max(1)
        best[first : first + len(s)] = k
        ratio[first : first + len(s)] = np.sqrt(
            np.maximum(1 - nearest, 0) / np.maximum(1 - second, 1e-6)
        )
    return best, ratio


def _nearest_bits(a, b):
    cv2 = need_opencv()
    pairs = cv2.BFMatcher(cv2.NORM_HAMMING).knnMatch(a, b, k=2)
    best = np.array([p[0].trainIdx for p in pairs], int)
    return best, np.array([p[0].distance / max(p[1].distance, 1) for p in pairs])
