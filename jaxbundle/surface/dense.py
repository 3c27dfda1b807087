"""Dense matching of rectified pairs: disparities found by a search, then least squares at every
pixel.

A pair with very many pixels and disparities is matched at half the size first, refined there, and
these disparities are refined in the original: the search takes eight times as long at twice the
size.

Source of the pyramid: Rothermel, Wenzel, Fritsch and Haala (2012), SURE: photogrammetric surface
reconstruction from imagery.
"""

from typing import Protocol

import numpy as np
from jaxtyping import Float

from jaxbundle.photographs.opencv import need_opencv
from jaxbundle.surface.disparity_refinement import JUMP, Disparities, refine_disparities
from jaxbundle.surface.disparity_search import alike, ambiguous, semi_global

MOST_SEARCHED = 4e9
"""Maximum pixels times disparities of a search; about ten seconds on two cores."""


class RowPair(Protocol):
    """Two images whose epipolar lines are rows; NaN outside."""

    @property
    def left(self) -> Float[np.ndarray, "rows columns"]: ...

    @property
    def right(self) -> Float[np.ndarray, "rows columns"]: ...


def match_dense(pair: RowPair, span: int) -> Disparities:
    """Disparities from 0 to `span` of a rectified pair, at the pixels of its left image."""
    left, right = _prepare(pair)
    inside = np.isfinite(pair.left)
    start = _search(left, right, inside, np.isfinite(pair.right), span)
    start[ambiguous(left, start, span)] = np.nan
    return refine_disparities(left, right, start)


def _search(left, right, inside, right_inside, span) -> Float[np.ndarray, "rows columns"]:
    """Disparities to about a quarter of a pixel, NaN where none was found; a large pair at half
    its size."""
    if left.size * (span + 1) <= MOST_SEARCHED:
        left, right = alike(left, right, inside, right_inside)
        found = semi_global(left, right, span)
    else:
        half, right_half = _halve(left), _halve(right)
        whole, right_whole = (_halve(a.astype(np.float32)) == 1 for a in (inside, right_inside))
        coarse = _search(half, right_half, whole, right_whole, span // 2 + 1)
        finer = refine_disparities(half, right_half, coarse).disparity
        found = _double(np.where(np.isfinite(finer), finer, coarse), left.shape)
    return np.where(inside & (found <= span), found, np.nan)


def _halve(a: Float[np.ndarray, "rows columns"]) -> Float[np.ndarray, "half_rows half_columns"]:
    """Means of 2 × 2 pixels, the last row and column repeated if needed."""
    cv2 = need_opencv()
    rows, columns = (n % 2 for n in a.shape)
    even = cv2.copyMakeBorder(a, 0, rows, 0, columns, cv2.BORDER_REPLICATE)
    return cv2.resize(even, (even.shape[1] // 2, even.shape[0] // 2), interpolation=cv2.INTER_AREA)


def _double(
    disparity: Float[np.ndarray, "half_rows half_columns"], shape: tuple[int, int]
) -> Float[np.ndarray, "rows columns"]:
    """Disparities of the image of twice the size: between similar neighbours interpolated, else
    those of the nearest."""
    cv2 = need_opencv()
    rows, columns = disparity.shape
    size = 2 * columns, 2 * rows
    scale = lambda a, way: cv2.resize(a, size, interpolation=way)
    nearest = scale(disparity, cv2.INTER_NEAREST)
    between = scale(disparity, cv2.INTER_LINEAR)
    with np.errstate(invalid="ignore"):
        similar = np.abs(between - nearest) < JUMP / 4
    return 2 * np.where(similar, between, nearest)[: shape[0], : shape[1]]


def _prepare(pair: RowPair):
    """Both images between 0 and 255, without gaps."""
    grey = [a[np.isfinite(a)] for a in (pair.left, pair.right)]
    if not all(len(g) for g in grey):
        return np.zeros_like(pair.left), np.zeros_like(pair.left)
    values = np.concatenate([g[:: max(1, len(g) // 200_000)] for g in grey])
    low, high = (
        (0.0, 255.0)
        if values.max() <= 260 and values.min() >= -5
        else (np.percentile(values, [0.2, 99.8]))
    )
    scale = 255 / max(high - low, 1e-9)
    left, right = (
        np.where(np.isfinite(a), (a - low) * scale, 0).astype(np.float32)
        for a in (pair.left, pair.right)
    )
    return left, right
