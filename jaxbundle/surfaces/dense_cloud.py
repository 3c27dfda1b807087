"""A cloud of most pixels of a base image, from rectified pairs with one or several others.

In a rectified pair the inverse distance of a pixel is linear in its disparity, q = d/(f·b·l) with l
the length of [x/f, y/f, 1]. So several pairs are averaged in q, weighted by σ; inconsistent values
are left out. Half of the variance of a match is due to the base image, common to all pairs: a shift
ε of its window, in any direction, changes the disparity of a pair by eₖ·ε, with eₖ its epipolar
line. So the errors of pairs k and l have the covariance ½·σₖ·σₗ·eₖ·eₗ.
"""

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from scipy import ndimage

from jaxbundle.surfaces.bounds import Bounds
from jaxbundle.surfaces.cloud import Cloud, empty_cloud
from jaxbundle.surfaces.dense import DenseSettings, match_dense
from jaxbundle.surfaces.disparity_refinement import Disparities
from jaxbundle.surfaces.guide import Guide
from jaxbundle.surfaces.orientation import orientation_covariance
from jaxbundle.surfaces.rectification import PIXELS_AT_ONCE, RectifiedPair, disparity_range, rectify
from jaxbundle.surfaces.views import FrameView, Places, Points
from jaxbundle.system.cores import available_cores


def dense_cloud(
    base: FrameView,
    others: Sequence[FrameView],
    find_guide: Callable[[], Guide | None],
    bounds: Bounds,
    step: int,
    settings: DenseSettings,
) -> tuple[Cloud, list[tuple[str, float]], list[str]]:
    """The cloud; name and variance factor of each image used; those that cannot be rectified.

    All disparities between the bounds are searched, unless they are very many: then those near
    the guide, `find_guide()`, which is made only then.
    """
    all_points = bound_points(base, bounds)
    columns, rows = base.size
    v, u = np.mgrid[0:rows:step, 0:columns:step].reshape(2, -1)
    uv = np.stack([u, v], 1).astype(float)
    pair_depths: list[_PairDepths] = []
    used_images, left_out = [], []
    for other in others:
        span = disparity_range(base, other, all_points)
        narrow = span is not None and span < settings.max_disparities
        guide = None if narrow else find_guide()
        X = all_points if guide is None else guide_points(base, guide)
        rectified = (
            rectify(base, other, X, settings.rectification) if narrow or guide is not None else None
        )
        if rectified is None:
            left_out.append(other.name)
            continue
        pair, span = rectified
        disparities = match_dense(pair, span, settings)
        pair_depths.append(_look_up(base, other, uv, pair, disparities, settings))
        used_images.append((other.name, disparities.factor))
    if not pair_depths:
        return empty_cloud(base.name), used_images, left_out
    parts = [
        _points(base, pair_depths, uv, slice(k, k + PIXELS_AT_ONCE), settings)
        for k in range(0, len(uv), PIXELS_AT_ONCE)
    ]
    X, covariance, rays, places, shared = (np.concatenate(p) for p in zip(*parts))
    image = np.zeros(len(X), np.int16)
    cloud = Cloud(X, covariance, rays, image, places, (base.name,), shared=shared)
    return cloud, used_images, left_out


def guide_points(base: FrameView, guide: Guide) -> Float[np.ndarray, "n 3"]:
    """The points of a guide's good nodes."""
    row, column, uv = guide.good_nodes()
    return base.points(uv, guide.q[row, column])


def bound_points(base: FrameView, bounds: Bounds) -> Float[np.ndarray, "n 3"]:
    """Points at both ends of lines of sight spread over an image."""
    # 9 × 9: the range of depths is that of its extremes, with a margin
    u, v = (np.linspace(0, n - 1, 9) for n in base.size)
    uv = np.stack(np.meshgrid(u, v), -1).reshape(-1, 2)
    q = bounds(uv)
    ends = np.concatenate([base.points(uv, np.maximum(q[:, k], 1e-12)) for k in (0, 1)])
    return ends[np.isfinite(ends).all(1)]


class _PairDepths(NamedTuple):
    """What a pair says of the pixels of the base: inverse distances and their σ (NaN: nothing); the
    direction of the base, and its length."""

    other: FrameView
    q: Float[np.ndarray, " n"]
    sigma: Float[np.ndarray, " n"]
    axis: Float[np.ndarray, "3"]
    length: float


def _look_up(
    base: FrameView,
    other: FrameView,
    uv: Places,
    pair: RectifiedPair,
    disparities: Disparities,
    settings: DenseSettings,
) -> _PairDepths:
    """What the disparities of a pair say of pixels of the base."""
    q, sigma = np.empty(len(uv)), np.empty(len(uv))

    def fill(begin: int) -> None:
        rows = slice(begin, begin + PIXELS_AT_ONCE)
        d = base.points(uv[rows], np.ones(len(uv[rows]))) - base.X0
        q[rows], sigma[rows] = _inverse_distance(
            base, d, pair, disparities, settings.max_interpolated_difference
        )

    with ThreadPoolExecutor(available_cores()) as pool:
        list(pool.map(fill, range(0, len(uv), PIXELS_AT_ONCE)))
    return _PairDepths(other, q, sigma, pair.R[0], pair.base)


def _points(
    base: FrameView,
    pair_depths: Sequence[_PairDepths],
    uv: Places,
    rows: slice,
    settings: DenseSettings,
) -> tuple[np.ndarray, ...]:
    """Points of some pixels, their covariance, numbers of rays, their pixels, and of the variance
    of Z that of the orientations."""
    q, s = (
        np.stack([getattr(pair, name)[rows] for pair in pair_depths]) for name in ("q", "sigma")
    )
    bases_in_image_plane = np.stack([pair.axis for pair in pair_depths])
    bases_in_image_plane = (
        bases_in_image_plane - (bases_in_image_plane @ base.M[2])[:, None] * base.M[2]
    )
    bases_in_image_plane = bases_in_image_plane / np.linalg.norm(
        bases_in_image_plane, axis=1, keepdims=True
    )
    q, variance, number = combine(
        q, s, bases_in_image_plane @ bases_in_image_plane.T, settings.max_difference
    )
    good = np.isfinite(q) & (q > 0)
    uv, q, variance, number = (a[good] for a in (uv[rows], q, variance, number))
    d = base.points(uv, np.ones(len(uv))) - base.X0
    length = 1 / q
    variance_of_distance = variance / q**4  # of the distance 1/q: σ = σ_q/q²
    # Across the line of sight: the part of a match's error due to the base image.
    pixel = np.sqrt(variance / 2) * pair_depths[0].length * length
    dd = d[:, :, None] * d[:, None]
    covariance = variance_of_distance[:, None, None] * dd + (pixel**2)[:, None, None] * (
        np.eye(3) - dd
    )
    X = base.X0 + length[:, None] * d
    is_used = np.concatenate([np.ones((1, len(X)), bool), np.isfinite(s[:, good])]).T
    views = [base, *(pair.other for pair in pair_depths)]
    of_orientation = orientation_covariance(views, X, is_used)
    covariance = (covariance + of_orientation).astype(np.float32)
    shared = of_orientation[:, 2, 2].astype(np.float32)
    return X, covariance, (number + 1).astype(np.int16), uv.astype(np.float32), shared


def _inverse_distance(
    base: FrameView, d: Points, pair: RectifiedPair, disparities: Disparities, max_difference: float
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """q and its σ along directions; NaN without disparity."""
    place = pair.places(base.X0 + d)
    rows, columns = disparities.disparity.shape
    is_inside = np.isfinite(place).all(1) & (place >= 0).all(1)
    is_inside &= (place[:, 0] <= columns - 1) & (place[:, 1] <= rows - 1)
    x, y = np.where(is_inside[:, None], place, 0.0).T
    j, i = (np.minimum(a.astype(int), n - 2) for a, n in ((x, columns), (y, rows)))
    four = np.stack([disparities.disparity[i + a, j + b] for a in (0, 1) for b in (0, 1)])
    smooth = np.isfinite(four).all(0) & (np.ptp(four, axis=0) < max_difference)
    known_disparities = np.where(np.isfinite(disparities.disparity), disparities.disparity, 0)
    interpolated = ndimage.map_coordinates(known_disparities, [y, x], order=1, mode="nearest")
    nearest = np.rint(y).astype(int), np.rint(x).astype(int)
    disparity = np.where(smooth, interpolated, disparities.disparity[nearest]) + pair.lowest
    scale = pair.f * pair.base / (d @ pair.R[2])
    q = np.where(is_inside, disparity / scale, np.nan)
    return q, np.where(is_inside, disparities.sigma[nearest] / scale, np.nan)


def combine(
    q: Float[np.ndarray, "pairs n"],
    sigma: Float[np.ndarray, "pairs n"],
    cosine: Float[np.ndarray, "pairs pairs"] | None = None,
    max_difference: float = DenseSettings.max_difference,
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"], np.ndarray]:
    """The weighted mean of consistent values, its variance, and their number. NaN if two
    disagree and no third decides. `cosine`: of the angles between epipolar lines, 1 if not
    given."""
    is_known = np.isfinite(q) & np.isfinite(sigma)
    if len(q) == 1:
        return np.where(is_known[0], q[0], np.nan), sigma[0] ** 2, is_known[0].astype(int)
    use = consistent(q, sigma, max_difference)
    number = use.sum(0)
    weight = np.where(use, 1 / np.where(use, sigma, 1) ** 2, 0)
    with np.errstate(invalid="ignore", divide="ignore"):
        mean = np.where(use, weight * np.where(use, q, 0), 0).sum(0) / weight.sum(0)
        pull = np.where(use, weight * np.where(use, sigma, 0), 0) / weight.sum(0)
        cosine = np.ones((len(q), len(q))) if cosine is None else cosine
        # Half of each variance is of the window in the base, common to all pairs; the other halves
        # are independent: Σwₖ²σₖ²/(Σw)² = 1/Σw for w = 1/σ².
        variance = np.einsum("kn,kl,ln->n", pull, cosine, pull) / 2 + 0.5 / weight.sum(0)
    return np.where(number > 0, mean, np.nan), variance, number


def consistent(
    q: Float[np.ndarray, "pairs n"], sigma: Float[np.ndarray, "pairs n"], max_difference: float
) -> Bool[np.ndarray, "pairs n"]:
    """Which values agree with the one that most agree with, within `max_difference` σ of the
    difference; none where two disagree and no third decides. NaN: no value."""
    is_known = np.isfinite(q) & np.isfinite(sigma)
    q, sigma = np.where(is_known, q, np.nan), np.where(is_known, sigma, np.nan)
    with np.errstate(invalid="ignore"):
        difference = np.abs(q[:, None] - q) / np.hypot(sigma[:, None], sigma)
        votes = (difference < max_difference).sum(1)
        best = np.where(is_known, votes, -1).argmax(0)
        use = is_known & (difference[best, :, np.arange(q.shape[1])].T < max_difference)
    return use & ((is_known.sum(0) < 2) | (use.sum(0) > 1))
