"""Refinement of disparities by least squares at every pixel of a rectified pair.

At each pixel a window follows the disparities found, R(x, y) = right(x − d(x, y), y), and a
correction is solved for, with a shift ε across the rows (`row_windows`). Rows are aligned, so that
ε should be 0: ε in units of its σ gives a variance factor (the median of ε²/σ² over that of χ²).
What the scatter of disparities farther apart than a window has beyond that, due to the shape of the
surface within the windows, is added, the same for all pixels. If noise dominates, the step is
repeated with larger windows, as long as they contain one surface.
"""

import dataclasses
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from scipy import ndimage

from jaxbundle.photographs.opencv import need_opencv
from jaxbundle.surfaces.disparity_search import RowImage, RowMask
from jaxbundle.surfaces.row_windows import correct
from jaxbundle.surfaces.scatter import missing_sigma, robust_factor
from jaxbundle.system.cores import available_cores


@dataclasses.dataclass(frozen=True)
class DisparityRefinementSettings:
    """Least squares at every pixel, and the σ of the disparities; pixels where nothing is said.

    Figures "half …, double …" are of `benchmarks/surface_accuracy.py "no texture" --dense`: 66 870
    points, RMS of errors over σ 1.003, robust 0.943, 0.106 % wrong by more than a pixel; those of
    other values are printed by `benchmarks/surface_settings.py --dense`.
    """

    half_window: int = 4
    """Half the side of the windows of least squares, 9 × 9 pixels. Half: 0.8 % more pixels, 0.089 %
    wrong; double: 0.9 % fewer, 0.22 % wrong, since windows reach over steps."""
    wide_half_window: int = 7
    """Half the side of the windows where the texture is weak. Half (3) and double: RMS 1.015,
    robust 0.967 and 0.951."""
    weak_sigma: float = 0.05
    """σ of a disparity above which the texture is weak. Half: robust RMS 0.949; double: 0.941."""
    min_weak_share: float = 0.02
    """Share of weak pixels below which no larger windows are tried: it only saves their time."""
    rounds: int = 2
    """Corrections of the shape that a window follows; the last is the result. 1: RMS 1.14, only
    98.1 % of the errors within 3 σ; 4: RMS 1.017, and more time."""
    hole_sigma: float = 0.5
    """σ of the disparity of a window that consists of gaps, by the root of their share. Determined
    on rendered roofs. Half: 2.5 % more pixels, 0.22 % wrong; double: 4 % fewer, 0.027 % wrong."""
    step_sigma: float = 0.3
    """σ added to a window with a step in the surface. Determined on rendered roofs. Half: 0.7 %
    fewer pixels, since windows with few gaps then count as steps, too; double: 1.7 % more, 98.6 %
    within 0.2 pixel (99.5)."""
    min_step: float = 2.5
    """Change of disparities in a window that is a step in the surface. Half and double: the same
    pixels within 0.02 %."""
    block_side: int = 48
    """Side of the blocks whose scatter gives σ: five windows without overlap on each side. Half:
    RMS 1.023; double: 0.956."""
    scatter_quantile: float = 0.25
    """Quantile of the blocks that is used: the smoother part of the surface. Half: RMS 1.023;
    double: 0.932."""
    surface_tolerance: float = 0.7
    """Differences of the disparities of one surface within a window: σ of the weights of their
    means. Half: robust RMS 0.936; double: 0.942."""
    max_change: float = 1.0
    """Maximum change of a disparity by least squares, which converges within about a pixel. Half:
    0.15 % fewer pixels; double: no difference."""
    max_last_change: float = 0.5
    """Maximum change by the last round. Half: 0.16 % fewer pixels; double: no difference."""
    min_correlation: float = 0.5
    """Minimum ρ of a window. 0.3: no difference; 0.8: 0.6 % fewer pixels, no fewer wrong."""
    min_step_correlation: float = 0.9
    """Minimum ρ of a window beside a step, where disparities of one side extend to the other. 0.35:
    1.2 % more pixels, 0.13 % wrong; 0.95: 0.4 % fewer, 0.093 % wrong."""
    min_contrast_ratio: float = 0.2
    """Minimum contrast h₁ of the left window relative to the right one (`row_windows`). Half: no
    difference; double: 0.1 % fewer pixels."""
    added_sigma: float = 0.014
    """σ added by interpolation and sampling: errors that depend on the fraction of the disparity
    are alike over whole surfaces, so that no scatter shows them. Half: RMS 1.005; double: 0.82, σ
    too large."""
    max_sigma: float = 0.5
    """σ above which the texture does not determine a disparity. Half: 5 % fewer pixels, none wrong;
    double: 0.118 % wrong."""
    piece: tuple[int, int] = (256, 512)
    """Rows and columns refined together, with their margins: few enough for a processor's cache."""


@dataclasses.dataclass(frozen=True)
class Disparities:
    """Disparity, its σ, ρ of the window; NaN: none. `factor`: of the variances of matching, which
    σ contains."""

    disparity: RowImage
    sigma: RowImage
    rho: RowImage
    factor: float


def refine_disparities(
    left: RowImage,
    right: RowImage,
    start: RowImage,
    settings: DisparityRefinementSettings = DisparityRefinementSettings(),
) -> Disparities:
    """Least squares at every pixel with a disparity."""
    spline = _RowSpline.fit(right)
    known = np.isfinite(start)
    half, wide_half = settings.half_window, settings.wide_half_window
    found, stepped = _refine_with_windows(left, spline, start, half, known, settings)
    with np.errstate(invalid="ignore"):
        weak = known & ~(found.sigma < settings.weak_sigma) & ~stepped
    if weak.sum() > settings.min_weak_share * known.sum():
        wide, over_step = _refine_with_windows(left, spline, start, wide_half, weak, settings)
        with np.errstate(invalid="ignore"):
            narrow = np.nan_to_num(found.sigma, nan=settings.max_sigma)
            better = weak & ~over_step & (wide.sigma < narrow)
        mixed = {
            name: np.where(better, getattr(wide, name), getattr(found, name))
            for name in ("disparity", "sigma", "rho")
        }
        found = dataclasses.replace(found, **mixed)
    return found


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
    ) -> RowImage:
        """Grey values at some rows, and at columns moved to the left by the disparities; beyond the
        edge those of the edge."""
        whole = np.floor(-disparity)
        t = -disparity - whole
        first = columns + whole.astype(np.int32)
        last = self.coefficients.shape[1] - 5
        t = np.where((first < 0) | (first >= last), 0, t)
        first = np.clip(first, 0, last) + self.coefficients.shape[1] * rows[:, None]
        flat = self.coefficients.ravel()
        t2, t3 = t * t, t * t * t
        # 6 times the cubic B-spline at −1 − t, −t, 1 − t, 2 − t
        weights = 1 - 3 * t + 3 * t2 - t3, 4 - 6 * t2 + 3 * t3, 1 + 3 * (t + t2 - t3), t3
        found = np.zeros(first.shape, np.float32)
        for k, weight in enumerate(weights):
            found += weight * flat.take(first + k + 1)
        return found / 6


def _refine_with_windows(
    left: RowImage,
    spline: _RowSpline,
    start: RowImage,
    half: int,
    wanted: RowMask,
    settings: DisparityRefinementSettings,
) -> tuple[Disparities, RowMask]:
    """Disparities by windows of 2·`half` + 1 pixels, with the factor of those wanted in σ; which
    windows have a step of the surface in them."""
    rows, columns = left.shape
    # In each round a pixel depends on a smooth shape and a window of least squares, `half` each,
    # and on two pixels for the gradients. The two pixels of the first median are left out: they
    # change a disparity by less than 1e-6 pixel.
    margin = 2 * settings.rounds * (half + 1)
    # many rounds have larger pieces: a third of one side, at least, is not margin
    sides = tuple(max(n, 3 * margin) for n in settings.piece)
    height, width = (n - 2 * margin for n in sides)
    d, sigma, rho, across = (np.full(left.shape, np.nan, np.float32) for _ in range(4))

    def refine(corner: tuple[int, int]) -> None:
        inner = tuple(slice(k, k + n) for k, n in zip(corner, (height, width)))
        if not wanted[inner].any():
            return
        v, u = (
            _reflect(np.arange(n) + k - margin, size)
            for k, n, size in zip(corner, sides, left.shape)
        )
        found = _refine_piece(left, spline, start, v, u, half, settings)
        for out, piece in zip((d, sigma, rho, across), found):
            place = out[inner]
            place[:] = piece[margin:, margin:][: place.shape[0], : place.shape[1]]

    corners = [(r, c) for r in range(0, rows, height) for c in range(0, columns, width)]
    with ThreadPoolExecutor(available_cores()) as pool:
        list(pool.map(refine, corners))
    good = np.isfinite(d)
    factor, noise = _estimate_noise(np.where(wanted, d, np.nan), sigma, across, half, settings)
    edges = _edge_variance(np.where(good, d, 0), good, half, settings)
    sigma = np.sqrt(noise**2 + edges)
    stepped = edges >= settings.step_sigma**2
    with np.errstate(invalid="ignore"):
        # beside a step the disparities of one side extend to the other
        good &= ~stepped | (rho >= settings.min_step_correlation)
        good &= sigma < settings.max_sigma
    keep = lambda a: np.where(good, a, np.nan)
    return Disparities(keep(d), keep(sigma), keep(rho), factor), stepped


def _estimate_noise(
    d: RowImage, sigma: RowImage, across: RowImage, half: int, settings: DisparityRefinementSettings
) -> tuple[float, RowImage]:
    """The variance factor, and σ of the disparities d."""
    factor = robust_factor(across[np.isfinite(d)])
    noise = np.hypot(np.sqrt(factor) * sigma, settings.added_sigma)
    apart = 2 * half + 1  # windows that do not overlap
    side, quantile = settings.block_side, settings.scatter_quantile
    shape = missing_sigma(d, noise, np.ones_like(noise), apart, side, quantile)
    if shape is not None:
        return factor, np.hypot(noise, shape)
    # The shifts across the rows show only the noise. Where the scatter is not known, a factor below
    # 1 could not be told from one of windows that are bent.
    factor = max(factor, 1.0)
    return factor, np.hypot(np.sqrt(factor) * sigma, settings.added_sigma)


def _reflect(index: Int[np.ndarray, " k"], n: int) -> Int[np.ndarray, " k"]:
    """Indices beyond the ends, reflected at the first and the last of `n`."""
    period = max(2 * (n - 1), 1)
    return (n - 1) - np.abs((n - 1) - index % period)


def _refine_piece(
    left: RowImage,
    spline: _RowSpline,
    start: RowImage,
    rows: Int[np.ndarray, " r"],
    columns: Int[np.ndarray, " c"],
    half: int,
    settings: DisparityRefinementSettings,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Disparities (NaN: none), their σ, ρ, and shifts across the rows over their σ, of some rows
    and columns."""
    piece = np.ix_(rows, columns)
    left, start = left[piece], start[piece]
    known = np.isfinite(start)
    shape = _smooth(_remove_noise(start, known), known, half, settings.surface_tolerance)
    moved = np.zeros_like(shape)
    for number in range(settings.rounds):
        if number > 0:
            # a smooth shape and the windows' mean of what is left of it: no bias from curvature
            shape = _smooth(
                np.where(known, shape + moved, np.nan), known, half, settings.surface_tolerance
            )
        right = spline.sample(rows, columns, np.where(known, shape, 0))
        found = correct(left, right, half)
        delta, sigma, across, rho, contrast, textured = (np.asarray(a) for a in found)
        moved = np.clip(np.nan_to_num(delta), -settings.max_change, settings.max_change)
    with np.errstate(invalid="ignore"):
        good = known & (np.abs(shape + moved - start) <= settings.max_change)
        good &= np.abs(delta) < settings.max_last_change
        good &= rho >= settings.min_correlation
        good &= textured & (contrast > settings.min_contrast_ratio)
    return np.where(good, shape + moved, np.nan), sigma, rho, across


def _edge_variance(
    d: RowImage, known: RowMask, half: int, settings: DisparityRefinementSettings
) -> RowImage:
    """The added variance of a window that extends beyond the surface: with pixels without
    disparity, or of another surface."""
    cv2 = need_opencv()
    window = (2 * half + 1, 2 * half + 1)
    holes = cv2.boxFilter((~known).astype(np.float32), -1, window)
    high = cv2.dilate(np.where(known, d, -1e4).astype(np.float32), np.ones(window, np.uint8))
    low = cv2.erode(np.where(known, d, 1e4).astype(np.float32), np.ones(window, np.uint8))
    stepped = known & (high - low > settings.min_step)
    return settings.hole_sigma**2 * holes + settings.step_sigma**2 * stepped


def _remove_noise(disparity: RowImage, known: RowMask) -> RowImage:
    """Medians of 5 × 5. Where one differs by 1.5 pixels or more, it may be of the other side of an
    edge, and the disparity is kept."""
    cv2 = need_opencv()
    median = cv2.medianBlur(np.where(known, disparity, -1e3).astype(np.float32), 5)
    with np.errstate(invalid="ignore"):
        return np.where(np.abs(median - disparity) < 1.5, median, disparity)


def _smooth(disparity: RowImage, known: RowMask, half: int, tolerance: float) -> RowImage:
    """Means of the similar disparities in a window."""
    cv2 = need_opencv()
    # OpenCV tabulates the weights between the smallest and the largest value: not too far apart
    far = np.min(disparity, initial=np.inf, where=known) - 10 * tolerance
    filled = np.where(known, disparity, far if known.any() else 0.0).astype(np.float32)
    smooth = cv2.bilateralFilter(filled, 2 * half + 1, tolerance, float(half))
    return np.where(known, smooth, np.nan).astype(np.float32)
