"""Dense matching of rectified pairs: disparities found by a search, then least squares at every
pixel.

A pair with very many pixels and disparities is matched at half the size first, refined there, and
these disparities are refined in the original: the search takes eight times as long at twice the
size.

Source of the pyramid: Rothermel, Wenzel, Fritsch and Haala (2012), SURE: photogrammetric surface
reconstruction from imagery.
"""

import dataclasses
from typing import Protocol

import numpy as np
from jaxtyping import Float

from jaxbundle.photographs.opencv import need_opencv
from jaxbundle.surfaces.disparity_refinement import (
    Disparities,
    DisparityRefinementSettings,
    refine_disparities,
)
from jaxbundle.surfaces.disparity_search import (
    MAX_SPAN,
    DisparitySearchSettings,
    RowImage,
    RowMask,
    equalise_exposures,
    find_repetitions,
    search_both_ways,
)
from jaxbundle.surfaces.rectification import RectificationSettings


@dataclasses.dataclass(frozen=True)
class DenseSettings:
    """Dense clouds: the search for disparities, their refinement, and the points of several
    pairs."""

    search: DisparitySearchSettings = DisparitySearchSettings()
    refinement: DisparityRefinementSettings = DisparityRefinementSettings()
    rectification: RectificationSettings = RectificationSettings()
    max_searched: float = 4e9
    """Maximum pixels times disparities of a search, about ten seconds on two cores; a larger pair
    is matched at half its size first."""
    max_guide_nodes: int = 25_000
    """Maximum nodes of guides, which give only the range of depths here."""
    max_points: int = 16_000_000
    """Points of all base images by default, which take 2.5 GB; more are thinned."""
    max_disparities: int = 320
    """Range of disparities up to which a pair of photographs is searched between the bounds of the
    depth, pixels; else near the guide, which may miss thin objects. Time and memory grow with
    it."""
    max_ground_disparities: int = 200
    """This limit for a piece of scanner or RPC images, by the median of the nodes of its guide."""
    max_interpolated_difference: float = 1.0
    """Maximum difference of the four disparities around a pixel that are interpolated, pixels: of
    more than that they are of two surfaces, and the nearest is used. Half and double: no
    difference."""
    max_difference: float = 4.0
    """Maximum difference of values of several pairs that agree, in σ of the difference: of normal
    errors one in 16 000 is larger. In the scene "four" half: 0.3 % fewer points, 0.095 % wrong by a
    pixel (0.101); double: no difference."""
    ground_piece: int = 1500
    """Side of the pieces of scanner and RPC images, pixels: their epipolar lines are straight
    within them to a fraction of a pixel, and memory does not depend on the size of the image."""


class RowPair(Protocol):
    """Two images whose epipolar lines are rows; NaN outside."""

    @property
    def left(self) -> RowImage: ...

    @property
    def right(self) -> RowImage: ...


def match_dense(pair: RowPair, span: int, settings: DenseSettings = DenseSettings()) -> Disparities:
    """Disparities from 0 to `span` of a rectified pair, at the pixels of its left image."""
    left, right = _prepare(pair)
    is_inside = np.isfinite(pair.left)
    start = _search(left, right, is_inside, np.isfinite(pair.right), span, settings)
    # Parts visible in one image only match the repetition of their texture in the other.
    start[find_repetitions(left, start, span, settings.search)] = np.nan
    return refine_disparities(left, right, start, settings.refinement, is_inside)


def _search(
    left: RowImage,
    right: RowImage,
    is_inside: RowMask,
    right_inside: RowMask,
    span: int,
    settings: DenseSettings,
) -> RowImage:
    """Disparities to about a quarter of a pixel, NaN where none was found; a large pair, or one of
    a range beyond OpenCV's, at half its size."""
    if left.size * (span + 1) <= settings.max_searched and span <= MAX_SPAN:
        left, right = equalise_exposures(left, right, is_inside, right_inside, settings.search)
        disparities = search_both_ways(left, right, span, settings.search)
    else:
        half_left, right_half = _halve(left), _halve(right)
        is_whole, right_whole = (
            _halve(a.astype(np.float32)) == 1 for a in (is_inside, right_inside)
        )
        coarse = _search(half_left, right_half, is_whole, right_whole, span // 2 + 1, settings)
        finer = refine_disparities(half_left, right_half, coarse, settings.refinement).disparity
        filled = np.where(np.isfinite(finer), finer, coarse)
        disparities = _double(filled, left.shape, settings.refinement.step / 2)
    return np.where(is_inside & (disparities <= span), disparities, np.nan)


def _halve(a: RowImage) -> Float[np.ndarray, "half_rows half_columns"]:
    """Means of 2 × 2 pixels, the last row and column repeated if needed."""
    cv2 = need_opencv()
    rows, columns = (n % 2 for n in a.shape)
    even = cv2.copyMakeBorder(a, 0, rows, 0, columns, cv2.BORDER_REPLICATE)
    return cv2.resize(even, (even.shape[1] // 2, even.shape[0] // 2), interpolation=cv2.INTER_AREA)


def _double(
    disparity: Float[np.ndarray, "half_rows half_columns"], shape: tuple[int, int], tolerance: float
) -> RowImage:
    """Disparities of the image of twice the size: interpolated where they differ from the nearest
    by less than the tolerance, else those of the nearest."""
    cv2 = need_opencv()
    rows, columns = disparity.shape
    size = 2 * columns, 2 * rows
    scale = lambda a, way: cv2.resize(a, size, interpolation=way)
    nearest = scale(disparity, cv2.INTER_NEAREST)
    interpolated = scale(disparity, cv2.INTER_LINEAR)
    with np.errstate(invalid="ignore"):
        similar = np.abs(interpolated - nearest) < tolerance
    return 2 * np.where(similar, interpolated, nearest)[: shape[0], : shape[1]]


def _prepare(pair: RowPair) -> tuple[RowImage, RowImage]:
    """Both images between 0 and 255, without gaps; 8-bit ones as they are."""
    grey = [a[np.isfinite(a)] for a in (pair.left, pair.right)]
    if not all(len(g) for g in grey):
        return np.zeros_like(pair.left), np.zeros_like(pair.left)
    # 200 000 values are enough for percentiles
    values = np.concatenate([g[:: max(1, len(g) // 200_000)] for g in grey])
    low, high = (
        (0.0, 255.0)
        # Of 8 bits; cubic splines overshoot a little.
        if values.max() <= 260 and values.min() >= -5
        else (np.percentile(values, [0.2, 99.8]))
    )
    scale = 255 / max(high - low, 1e-9)
    left, right = (
        np.where(np.isfinite(a), (a - low) * scale, 0).astype(np.float32)
        for a in (pair.left, pair.right)
    )
    return left, right
