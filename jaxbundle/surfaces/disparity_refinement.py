"""Refinement of disparities by least squares at every pixel of a rectified pair.

At each pixel windows of several sizes follow the disparities found, R(x, y) = right(x − d(x, y),
y), and a correction is solved for, with a shift ε across the rows (`row_windows`). Rows are
aligned, so that ε should be 0: ε in units of its σ gives a variance factor for each size (the
median of ε²/σ² over that of χ²). Of the sizes h each pixel takes the one of the least mean square
error

    V_h = σ_h² + B_h²,    B_h² = mean of (d_h − d₀)² − (σ₀² − σ_h²) around the pixel,

with d₀ by the smallest windows: what a larger window differs from them by beyond its noise is the
shape of the surface in it. The variance of a disparity is the sum of

- V_h, and the square of `added_sigma`; instead of σ_h² 2·r² where that is larger, with r² the mean
  square of the disparities about their plane in a window of 9 × 9 pixels: relief that no window
  follows, by which a pixel and what its window shows both differ from the plane. r² contains the
  noise;
- what the scatter of disparities farther apart than a window has beyond these, the same for all
  pixels;
- P·Δ² beside a step, a change of the disparity by Δ: P is the probability that the pixel is of the
  other surface, or hidden in the other image. It falls with the distance from the step, and is
  smaller for a pixel whose window has texture of its own. Where it is large, no disparity is given.

Sources: Kanade and Okutomi (1994), A stereo matching algorithm with an adaptive window (the choice
of windows by noise and shape).
"""

import dataclasses
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from scipy import ndimage

from jaxbundle.photographs.opencv import need_opencv
from jaxbundle.surfaces.disparity_search import RowImage, RowMask
from jaxbundle.surfaces.row_windows import RowCorrections, RowWindows
from jaxbundle.surfaces.scatter import missing_sigma, robust_factor
from jaxbundle.system.cores import available_cores


@dataclasses.dataclass(frozen=True)
class DisparityRefinementSettings:
    """Least squares at every pixel, and the σ of the disparities; pixels where nothing is said.

    Figures are means of ten real pairs (`benchmarks/surface_pairs.py`): 74.8 % of the pixels have a
    disparity, 1.3 % of them wrong by more than two pixels, 3.0 % of the errors beyond 3 σ.
    """

    half_windows: tuple[int, ...] = (2, 4, 7)
    """Half the sides of the windows of least squares, ascending: 5 × 5, 9 × 9, 15 × 15 pixels. With
    (2, 5, 10) 3.2 % of the errors are beyond 3 σ, with a fourth size, 12, 3.3 %, for 0.3 % more
    pixels."""
    shape_half_window: int = 4
    """Half the side of the windows in which relief is measured and steps are looked for, and at
    least that of the means of similar disparities that windows follow."""
    rounds: int = 2
    """Corrections of the shape that a window follows; the last is the result. One was not enough
    with windows of one size: RMS of errors over σ 1.14 on rendered photographs."""
    surface_tolerance: float = 0.7
    """Differences of the disparities of one surface within a window: σ of the weights of their
    means."""
    max_change: float = 1.0
    """Maximum change of a disparity by least squares, which converges within about a pixel."""
    max_last_change: float = 0.5
    """Maximum change by the last round."""
    min_correlation: float = 0.3
    """Minimum ρ of a window."""
    min_contrast_ratio: float = 0.2
    """Minimum contrast h₁ of the left window relative to the right one (`row_windows`)."""
    step: float = 1.5
    """Difference of the disparities of neighbours, within 3 × 3 pixels, that is a step in the
    surface: steeper surfaces than 37° of the disparities are rare, and hardly seen by both
    images."""
    outliers_at_step: float = 0.5
    """Probability that a disparity beside a step, or beside pixels without disparity, is of the
    other surface, if its window has no texture of its own. This and the two following are measured
    on 25 real pairs with true disparities (`benchmarks/surface_pairs.py --outliers`)."""
    outlier_range: float = 3.6
    """Distance from a step over which this probability falls to 1/e, pixels."""
    textured_outliers: float = 0.3
    """The probability of a window with texture of its own, relative to one without."""
    max_outliers: float = 0.25
    """Maximum probability of a wrong surface: where it is larger, there is no disparity. 0.15:
    72.4 % of the pixels, 1.0 % wrong by two pixels, 2.8 % beyond 3 σ."""
    likely_outliers: float = 0.1
    """Probability of a wrong surface from which its σ is at least that of a step of
    `unseen_step`."""
    unseen_step: float = 3.0
    """Least height of a step, where a wrong surface is likely: half of the wrong disparities of
    these pairs are off by more, often from a surface that has no disparities near."""
    max_step: float = 5.5
    """Greatest height of a step that is used: σ of a window with texture of its own beside any step
    is then √(0.3·0.5·exp(−1/3.6))·5.5 = 1.9 pixels, and objects a few pixels wide are kept."""
    block_side: int = 48
    """Side of the blocks whose scatter gives σ: three of the largest windows without overlap."""
    scatter_quantile: float = 0.25
    """Quantile of the blocks that is used: the smoother part of the surface."""
    added_sigma: float = 0.005
    """σ added by interpolation and sampling: errors that depend on the fraction of the disparity
    are alike over whole surfaces, so that no scatter shows them. 0.014: RMS of errors over σ 0.92
    instead of 0.98 in the scene "two" of `benchmarks/surface_accuracy.py`."""
    max_sigma: float = 2.0
    """Maximum σ of a disparity, pixels. Half: 3 % fewer pixels, 1.0 % wrong by two pixels; double:
    2 % more, 1.8 %."""
    piece: tuple[int, int] = (512, 768)
    """Rows and columns refined together, at most, with their margins of 32: an array of them has
    1.6 MB. Half: a fifth more time, since more of them are margins."""


@dataclasses.dataclass(frozen=True)
class Disparities:
    """Disparity and its σ, NaN: none; the probability that it is of another surface. `factor`: of
    the variances of matching by the middle windows, which σ contains."""

    disparity: RowImage
    sigma: RowImage
    outliers: RowImage
    factor: float


def refine_disparities(
    left: RowImage,
    right: RowImage,
    start: RowImage,
    settings: DisparityRefinementSettings = DisparityRefinementSettings(),
    is_inside: RowMask | None = None,
) -> Disparities:
    """Least squares at every pixel with a disparity. `is_inside`: pixels of the left image, all if
    not given."""
    sizes, own_texture = _match_windows(left, right, start, settings)
    chosen = _choose_windows(sizes, settings)
    in_image = np.ones(start.shape, bool) if is_inside is None else is_inside
    distance, step = _find_steps(start, in_image, settings)
    outliers = settings.outliers_at_step * np.exp(-distance / settings.outlier_range)
    outliers = np.where(own_texture, settings.textured_outliers * outliers, outliers)
    # A step itself, and its neighbours: two surfaces in their smallest windows.
    good = np.isfinite(chosen.disparity) & (outliers <= settings.max_outliers) & (distance >= 1)
    d = np.where(good, chosen.disparity, np.float32(np.nan))
    relief = _measure_relief(d, settings.shape_half_window)
    sigma = _add_scatter(d, chosen, relief, settings)
    likely = outliers > settings.likely_outliers
    step = np.where(likely, np.maximum(step, settings.unseen_step), step)
    step = np.minimum(step, settings.max_step)
    sigma = np.sqrt(sigma**2 + outliers * step**2)
    with np.errstate(invalid="ignore"):
        good &= sigma < settings.max_sigma
    keep = lambda a: np.where(good, a, np.float32(np.nan)).astype(np.float32)
    return Disparities(keep(d), keep(sigma), keep(outliers), chosen.factor)


class _SizeMatches(NamedTuple):
    """Disparities by windows of one size (NaN: none), their σ without a variance factor, and shifts
    across the rows over their σ."""

    disparity: RowImage
    sigma: RowImage
    across: RowImage


class _ChosenMatches(NamedTuple):
    """Disparities, each by the windows of the size chosen for it; the variance by noise, without
    and with its factor, and by the shape of the surface in the window; the factor of the middle
    size."""

    disparity: RowImage
    noise: RowImage
    scaled_noise: RowImage
    shape: RowImage
    factor: float


def _match_windows(
    left: RowImage, right: RowImage, start: RowImage, settings: DisparityRefinementSettings
) -> tuple[list[_SizeMatches], RowMask]:
    """Matches by all sizes of windows; which of the smallest have texture of their own."""
    rows, columns = left.shape
    spline, filled = _RowSpline.fit(right), _fill_from_background(start)
    # In each round a pixel depends on a smooth shape, a window of least squares, and two pixels for
    # the gradients. The two pixels of the first median are left out: they change a disparity by
    # less than 1e-6 pixel.
    largest = max(settings.half_windows)
    reach = max(settings.shape_half_window, largest) + largest + 2
    margin = settings.rounds * reach
    # Many rounds have larger pieces: a third of one side, at least, is not margin.
    piece_sizes = [max(n, 3 * margin) - 2 * margin for n in settings.piece]
    # Pieces of one size without an almost empty last one.
    height, width = (-(-n // -(-n // m)) for n, m in zip(left.shape, piece_sizes))
    sides = height + 2 * margin, width + 2 * margin
    matches = np.full((len(settings.half_windows), 3, rows, columns), np.nan, np.float32)
    has_own_texture = np.zeros(left.shape, bool)

    def refine(corner: tuple[int, int]) -> None:
        inner = tuple(slice(k, k + n) for k, n in zip(corner, (height, width)))
        if not np.isfinite(start[inner]).any():
            return
        v, u = (
            _reflect(np.arange(n) + k - margin, size)
            for k, n, size in zip(corner, sides, left.shape)
        )
        piece_matches, textured = _refine_piece(left, spline, start, filled, v, u, settings)
        place = has_own_texture[inner]
        middle = tuple(slice(margin, margin + n) for n in place.shape)
        place[:] = textured[middle]
        for out, size in zip(matches, piece_matches):
            for values, piece in zip(out, size):
                values[inner] = piece[middle]

    corners = [(r, c) for r in range(0, rows, height) for c in range(0, columns, width)]
    with ThreadPoolExecutor(available_cores()) as pool:
        list(pool.map(refine, corners))
    return [_SizeMatches(*size) for size in matches], has_own_texture


def _refine_piece(
    left: RowImage,
    spline: "_RowSpline",
    start: RowImage,
    filled: RowImage,
    rows: Int[np.ndarray, " r"],
    columns: Int[np.ndarray, " c"],
    settings: DisparityRefinementSettings,
) -> tuple[list[_SizeMatches], RowMask]:
    """Matches of some rows and columns by all sizes of windows; which of the smallest have texture
    of their own."""
    piece = np.ix_(rows, columns)
    left, start, filled = left[piece], start[piece], filled[piece]
    is_known = np.isfinite(start)
    half_window, tolerance = settings.shape_half_window, settings.surface_tolerance
    limit = settings.max_change
    first_shape = _smooth(_remove_noise(start, is_known), is_known, half_window, tolerance)
    follow = lambda shape: RowWindows(left, spline.sample(rows, columns, shape, filled), is_known)
    first_windows, matches, own_texture = follow(first_shape), [], np.zeros(left.shape, bool)
    # Every size has shapes of its own: where they differ, windows of some sizes are bent.
    for size in settings.half_windows:
        shape, windows = first_shape, first_windows
        for _ in range(settings.rounds - 1):
            delta = np.clip(np.nan_to_num(windows.correct(size).delta), -limit, limit)
            # A smooth shape and the windows' mean of what is left of it: no bias from curvature.
            shape = _smooth(
                np.where(is_known, shape + delta, np.nan),
                is_known,
                max(half_window, size),
                tolerance,
            )
            windows = follow(shape)
        corrections = windows.correct(size)
        if not matches:
            own_texture = windows.find_own_texture(size, corrections.noise)
        matches.append(_accept(corrections, shape, start, settings))
    return matches, own_texture


def _accept(
    corrections: RowCorrections,
    shape: RowImage,
    start: RowImage,
    settings: DisparityRefinementSettings,
) -> _SizeMatches:
    """The matches by windows of one size, NaN where they are not accepted."""
    d = shape + corrections.delta
    with np.errstate(invalid="ignore"):
        good = np.abs(d - start) <= settings.max_change
        good &= np.abs(corrections.delta) < settings.max_last_change
        good &= corrections.rho >= settings.min_correlation
        good &= corrections.contrast > settings.min_contrast_ratio
    return _SizeMatches(
        np.where(good, d, np.nan), corrections.sigma, corrections.normalised_row_shift
    )


def _choose_windows(
    sizes: Sequence[_SizeMatches], settings: DisparityRefinementSettings
) -> _ChosenMatches:
    """Of every pixel the windows of the least mean square error."""
    smallest, factors = sizes[0], [robust_factor(s.across[np.isfinite(s.disparity)]) for s in sizes]
    noise = [size.sigma**2 for size in sizes]
    # Beyond the noise: a mean of squares over the largest window, of differences that are alike
    # over the smallest, has the relative standard deviation √(2/9).
    reach, limit = max(settings.half_windows), 1 + np.sqrt(2 / 9)
    shapes, bends = [], []
    for k in range(1, len(sizes)):
        with np.errstate(invalid="ignore"):
            squared_difference = (sizes[k].disparity - smallest.disparity) ** 2
            expected = np.maximum(factors[0] * noise[0] - factors[k] * noise[k], 0)
            squared_difference, expected = (
                _mean_of_known(np.where(np.isfinite(squared_difference), a, np.nan), reach)
                for a in (squared_difference, expected)
            )
            shapes.append(np.maximum(squared_difference - expected, 0))
            bends.append(np.maximum(squared_difference - limit * expected, 0))
    # What bends the surface moves a disparity by the square of the side of the window, so that its
    # variance grows by the fourth power.
    halves = settings.half_windows
    for values in (shapes, bends):
        values.insert(0, values[0] * (halves[0] / halves[1]) ** 4)
    shape = smallest.disparity.shape
    best, *chosen_arrays = (np.full(shape, value, np.float32) for value in (np.inf, *[np.nan] * 4))
    for size, factor, variance, bent, bend in zip(sizes, factors, noise, shapes, bends):
        with np.errstate(invalid="ignore"):
            error = factor * variance + bend
            better = np.isfinite(size.disparity) & (error < best)
        best[better] = error[better]
        for out, values in zip(chosen_arrays, (size.disparity, variance, factor * variance, bent)):
            out[better] = values[better]
    return _ChosenMatches(*chosen_arrays, factor=factors[len(factors) // 2])


def _mean_of_known(a: RowImage, half_window: int) -> RowImage:
    """Means of the known values in windows around each pixel; NaN where there are none."""
    is_known = np.isfinite(a)
    cv2 = need_opencv()
    window = (2 * half_window + 1, 2 * half_window + 1)
    total, weight = (
        cv2.boxFilter(x, -1, window, normalize=False, borderType=cv2.BORDER_REFLECT_101)
        for x in (np.where(is_known, a, 0).astype(a.dtype), is_known.astype(a.dtype))
    )
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(weight > 0.5, total / weight, np.nan)


def _measure_relief(d: RowImage, half_window: int) -> RowImage:
    """Root mean squares of disparities about their planes in windows."""
    cv2 = need_opencv()
    # Double precision: squares of disparities of hundreds of pixels, and relief of hundredths.
    d = d.astype(np.float64)
    mean = _mean_of_known(d, half_window)
    square = _mean_of_known(d * d, half_window) - mean * mean
    # An unknown disparity has no effect on the slopes as the mean of those known.
    around = np.nan_to_num(np.where(np.isfinite(d), d, mean))
    offset = np.arange(-half_window, half_window + 1, dtype=float)
    variance_of_offset = float(np.mean(offset**2))
    slope, mean_kernel = (
        offset / (len(offset) * variance_of_offset),
        np.full(len(offset), 1 / len(offset)),
    )
    border = cv2.BORDER_REFLECT_101
    slope_along = cv2.sepFilter2D(around, cv2.CV_64F, slope, mean_kernel, borderType=border)
    slope_across = cv2.sepFilter2D(around, cv2.CV_64F, mean_kernel, slope, borderType=border)
    return np.sqrt(np.maximum(square - variance_of_offset * (slope_along**2 + slope_across**2), 0))


def _add_scatter(
    d: RowImage, chosen: _ChosenMatches, relief: RowImage, settings: DisparityRefinementSettings
) -> RowImage:
    """σ by noise, shape, relief, and what the scatter of the disparities has beyond them."""
    added_variance = chosen.shape + settings.added_sigma**2
    sigma = np.sqrt(np.maximum(chosen.scaled_noise, 2 * relief**2) + added_variance)
    window_distance = 2 * max(settings.half_windows) + 1  # windows that do not overlap
    side, quantile = settings.block_side, settings.scatter_quantile
    missing_noise = missing_sigma(d, sigma, np.ones_like(sigma), window_distance, side, quantile)
    if missing_noise is not None:
        return np.hypot(sigma, missing_noise)
    # The shifts across the rows show only the noise. Where the scatter is not known, a factor below
    # 1 could not be told from one of windows that are bent.
    return np.maximum(sigma, np.sqrt(chosen.noise + added_variance))


def _fill_from_background(d: RowImage) -> RowImage:
    """Unknown disparities as the smaller of the nearest known ones on their row: those hidden in
    the other image are of the surface behind. 0 in rows without any."""
    columns = np.arange(d.shape[1])
    is_known = np.isfinite(d)
    column_before = np.maximum.accumulate(np.where(is_known, columns, -1), axis=1)
    column_after = np.minimum.accumulate(
        np.where(is_known, columns, len(columns))[:, ::-1], axis=1
    )[:, ::-1]
    take_columns = lambda at: np.take_along_axis(d, np.clip(at, 0, len(columns) - 1), axis=1)
    beyond = np.float32(np.inf)
    lower = np.minimum(
        np.where(column_before >= 0, take_columns(column_before), beyond),
        np.where(column_after < len(columns), take_columns(column_after), beyond),
    )
    return np.where(is_known, d, np.where(np.isfinite(lower), lower, 0)).astype(np.float32)


def _find_steps(
    d: RowImage, is_inside: RowMask, settings: DisparityRefinementSettings
) -> tuple[RowImage, RowImage]:
    """Distances to the nearest step of the disparities, or to the nearest pixel `is_inside` the
    image without one; and the height of the highest step in a window."""
    cv2 = need_opencv()
    filled, is_known = _fill_from_background(d), np.isfinite(d)
    span = lambda a, side: (
        cv2.dilate(a, np.ones((side, side))),
        cv2.erode(a, np.ones((side, side))),
    )
    high, low = (np.where(is_known, d, value).astype(np.float32) for value in (-1e4, 1e4))
    at_step = is_known & (span(high, 3)[0] - span(low, 3)[1] > settings.step)
    clear = ~(at_step | (is_inside & ~is_known))
    distance = cv2.distanceTransform(clear.astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    high, low = span(filled, 2 * settings.shape_half_window + 1)
    return distance, np.maximum(high - filled, filled - low)


class _RowSpline(NamedTuple):
    """Coefficients of the cubic splines along the rows of an image, two more at each end."""

    coefficients: Float[np.ndarray, "rows more_columns"]

    @classmethod
    def fit(cls, image: RowImage) -> "_RowSpline":
        rows = ndimage.spline_filter1d(image, 3, axis=1, output=np.float32)
        return cls(np.pad(rows, [(0, 0), (2, 2)], mode="reflect"))

    def sample(
        self,
        rows: Int[np.ndarray, " rows"],
        columns: Int[np.ndarray, " columns"],
        disparity: RowImage,
        otherwise: RowImage,
    ) -> RowImage:
        """Grey values at some rows, and at columns moved to the left by the disparities, or by
        others where these are unknown; beyond the edge those of the edge."""
        disparity = np.where(np.isfinite(disparity), disparity, otherwise)
        whole_shift = np.floor(-disparity)
        t = -disparity - whole_shift
        first_column = columns + whole_shift.astype(np.int32)
        last_column = self.coefficients.shape[1] - 5
        t = np.where((first_column < 0) | (first_column >= last_column), 0, t)
        first_column = (
            np.clip(first_column, 0, last_column) + self.coefficients.shape[1] * rows[:, None]
        )
        flat = self.coefficients.ravel()
        t2, t3 = t * t, t * t * t
        # 6 times the cubic B-spline at −1 − t, −t, 1 − t, 2 − t
        weights = 1 - 3 * t + 3 * t2 - t3, 4 - 6 * t2 + 3 * t3, 1 + 3 * (t + t2 - t3), t3
        sums = np.zeros(first_column.shape, np.float32)
        for k, weight in enumerate(weights):
            sums += weight * flat.take(first_column + k + 1)
        return sums / 6


def _reflect(index: Int[np.ndarray, " k"], n: int) -> Int[np.ndarray, " k"]:
    """Indices beyond the ends, reflected at the first and the last of `n`."""
    period = max(2 * (n - 1), 1)
    return (n - 1) - np.abs((n - 1) - index % period)


def _remove_noise(disparity: RowImage, is_known: RowMask) -> RowImage:
    """Medians of 5 × 5. Where one differs by 1.5 pixels or more, it may be of the other side of an
    edge, and the disparity is kept."""
    cv2 = need_opencv()
    median = cv2.medianBlur(np.where(is_known, disparity, -1e3).astype(np.float32), 5)
    with np.errstate(invalid="ignore"):
        return np.where(np.abs(median - disparity) < 1.5, median, disparity)


def _smooth(disparity: RowImage, is_known: RowMask, half_window: int, tolerance: float) -> RowImage:
    """Means of the similar disparities in a window."""
    cv2 = need_opencv()
    # OpenCV tabulates the weights between the smallest and the largest value: not too far apart
    beyond_range = np.min(disparity, initial=np.inf, where=is_known) - 10 * tolerance
    filled = np.where(is_known, disparity, beyond_range if is_known.any() else 0.0).astype(
        np.float32
    )
    smooth = cv2.bilateralFilter(filled, 2 * half_window + 1, tolerance, float(half_window))
    return np.where(is_known, smooth, np.nan).astype(np.float32)
