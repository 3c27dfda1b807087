"""Matching features of two photographs: mutually nearest and distinct.

Descriptors of SIFT are the square roots of their normalised counts (Arandjelović and Zisserman,
2012), of unit length, so that the squared Euclidean distance of two is 2 − 2·a·b: one matrix
product for all pairs. The distance used here is √(1 − a·b), 1/√2 of the Euclidean one: it is 0 for
equal descriptors and 1 for orthogonal ones.

A match is kept if it is mutually the best, and if its distance is below `max_ratio` times that
of the second best in the other photograph (Lowe, 2004), in both directions, and of the most similar
feature in its own photograph: with identical windows the wrong match is as good as the right one.

Windows seen at different angles are not identical, and one may be more similar to another window of
the second photograph, seen at the same angle, than to itself. So a match also has a flag
`unique`: no feature in either photograph is as similar to it as two photographs of one
point usually are.
"""

import dataclasses
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Float32, Int, UInt8

from jaxbundle.photographs.opencv import need_opencv
from jaxbundle.tiepoints.features import Features

# Features processed at once for distances to all others: 25 MB of float32 beside 6000 features,
# small beside the photographs, and large enough for a fast matrix product.
ROWS_AT_ONCE = 1024
# Numbers of a descriptor of SIFT: 8 directions in 4 × 4 cells (Lowe, 2004).
SIFT_LENGTH = 4 * 4 * 8


@dataclasses.dataclass(frozen=True)
class FeatureMatchingSettings:
    """Settings of the matching of features."""

    max_ratio: float = 0.8
    """Maximum distance of a match relative to that of the second best. Lowe (2004, figure 11): 0.8
    removes 90 % of the false matches and less than 5 % of the right ones."""
    similar_distance: float = 0.22
    """Distance, 0 to 1, below which two features of a photograph may be repetitions: most true
    matches of SIFT are closer than this. Smaller: repeated windows count as unique; larger: hardly
    any feature is unique, and pairs are oriented by all matches."""


class FeatureMatches(NamedTuple):
    """Rows of matching features of two photographs, the most distinct first; the ratio of
    their distance to that of the second best; and which are unique in the photographs."""

    images: tuple[int, int]
    rows: Int[np.ndarray, "n 2"]
    distance_ratio: Float[np.ndarray, " n"]
    unique: Bool[np.ndarray, " n"]

    def take(self, chosen: Int[np.ndarray, " m"] | Bool[np.ndarray, " n"]) -> "FeatureMatches":
        """The chosen matches."""
        return FeatureMatches(
            self.images,
            self.rows[chosen],
            self.distance_ratio[chosen],
            self.unique[chosen],
        )


def match_features(
    one: Features,
    other: Features,
    settings: FeatureMatchingSettings = FeatureMatchingSettings(),
    within: tuple[Float[np.ndarray, " a"], Float[np.ndarray, " b"]] | None = None,
) -> tuple[Int[np.ndarray, "n 2"], Float[np.ndarray, " n"]]:
    """Rows of matching features, the most distinct first, and the ratio of their distances to those
    of the second best.

    **Arguments:** `within`: `distances_within` both photographs."""
    if min(len(one), len(other)) < 2 or one.descriptor.shape[1] != other.descriptor.shape[1]:
        return np.zeros((0, 2), int), np.zeros(0)
    sift = one.descriptor.shape[1] == SIFT_LENGTH
    nearest = _find_nearest if sift else _find_nearest_bits
    a, b = (_root(f.descriptor) if sift else f.descriptor for f in (one, other))
    best, distance, second_distance = nearest(a, b)
    if within is not None:
        second_distance = np.minimum(second_distance, np.minimum(within[0], within[1][best]))
    # Most features are dropped here, and need no search in the other direction.
    rows = np.flatnonzero(distance < settings.max_ratio * second_distance)
    if not len(rows):
        return np.zeros((0, 2), int), np.zeros(0)
    nearest_back, _, second_back = nearest(b[best[rows]], a)
    # Descriptors closer than 1e-3 are equal: three times √ε of float32, the rounding of √(1 − a·b).
    # This floor holds for the best, too: if two features equal one of the other photograph, the
    # ratio is 1.
    equal = 1e-3
    distance_ratio = np.maximum(distance[rows], equal) / np.maximum(
        np.minimum(second_distance[rows], second_back), equal
    )
    is_mutual = np.flatnonzero((nearest_back == rows) & (distance_ratio < settings.max_ratio))
    # Stable: equal ratios keep their order on every machine.
    is_mutual = is_mutual[np.argsort(distance_ratio[is_mutual], kind="stable")]
    rows = rows[is_mutual]
    return np.stack([rows, best[rows]], 1), distance_ratio[is_mutual]


def are_unique(
    rows: Int[np.ndarray, "n 2"],
    within: tuple[Float[np.ndarray, " a"], Float[np.ndarray, " b"]],
    settings: FeatureMatchingSettings = FeatureMatchingSettings(),
) -> Bool[np.ndarray, " n"]:
    """Which matches are not similar to any other feature of their photographs."""
    nearest = np.minimum(within[0][rows[:, 0]], within[1][rows[:, 1]])
    return nearest >= settings.similar_distance


def count_matches_of_largest(features_a: Features, features_b: Features, max_features: int) -> int:
    """The number of matches of the largest features, at most `max_features` of each photograph: a
    quick check whether two overlap (Wu, 2013, preemptive matching)."""
    # Features are in order of their size; the largest survive the largest changes of scale.
    largest = slice(max_features)
    return len(match_features(features_a.take(largest), features_b.take(largest))[0])


def _root(descriptor: UInt8[np.ndarray, "n 128"]) -> Float32[np.ndarray, "n 128"]:
    counts = descriptor.astype(np.float32)
    return np.sqrt(counts / np.maximum(counts.sum(1, keepdims=True), 1e-9))


def distances_within(features: Features) -> Float[np.ndarray, " n"]:
    """For every feature the distance to the most similar one elsewhere in its photograph; infinite
    for binary descriptors."""
    n = len(features)
    nearest = np.full(n, np.inf)
    if n < 2 or features.descriptor.shape[1] != SIFT_LENGTH:
        return nearest
    a, xy = _root(features.descriptor), features.xy.astype(np.float32)
    squared_size = features.size.astype(np.float32) ** 2
    for begin in range(0, n, ROWS_AT_ONCE):
        rows = slice(begin, begin + ROWS_AT_ONCE)
        s = a[rows] @ a.T
        # Not itself, nor the other directions and scales that SIFT gives one place: those are no
        # repetition.
        squared_distance = (xy[rows, None, 0] - xy[:, 0]) ** 2 + (xy[rows, None, 1] - xy[:, 1]) ** 2
        s[squared_distance <= squared_size[rows, None]] = -1
        nearest[rows] = _distance(s.max(1))
    return nearest


def _find_nearest(
    a: Float32[np.ndarray, "n 128"], b: Float32[np.ndarray, "m 128"]
) -> tuple[Int[np.ndarray, " n"], Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """The nearest row of b for each row of a, its distance, and that of the second."""
    best, distance, second_distance = np.empty(len(a), int), np.empty(len(a)), np.empty(len(a))
    for begin in range(0, len(a), ROWS_AT_ONCE):
        s = a[begin : begin + ROWS_AT_ONCE] @ b.T
        rows, all_rows = slice(begin, begin + len(s)), np.arange(len(s))
        k = s.argmax(1)
        best[rows], distance[rows] = k, _distance(s[all_rows, k])
        s[all_rows, k] = -1
        second_distance[rows] = _distance(s.max(1))
    return best, distance, second_distance


def _distance(product: Float32[np.ndarray, " n"]) -> Float32[np.ndarray, " n"]:
    return np.sqrt(np.maximum(1 - product, 0))


def _find_nearest_bits(
    a: UInt8[np.ndarray, "n bytes"], b: UInt8[np.ndarray, "m bytes"]
) -> tuple[Int[np.ndarray, " n"], Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """The same columns as `_find_nearest` for binary descriptors, by Hamming's distance."""
    cv2 = need_opencv()
    pairs = cv2.BFMatcher(cv2.NORM_HAMMING).knnMatch(a, b, k=2)
    best = np.array([p[0].trainIdx for p in pairs], int)
    distance, second_distance = (np.array([float(p[k].distance) for p in pairs]) for k in (0, 1))
    return best, distance, second_distance
