"""Dense matching of rectified pairs: semi-global matching, then least squares at every pixel.

OpenCV's semi-global matching gives disparities to about a quarter of a pixel. At each pixel a
window then follows the disparities found, R(x, y) = right(x − d(x, y), y), and

    left + v = h₀ + h₁·R + g_x·δ + g_y·ε

is solved for a correction δ of the disparity, a shift ε across the rows, brightness and contrast.
Rows are aligned, so that ε should be 0: ε in units of its σ gives a variance factor
(the median of ε²/σ² over that of χ²). Third differences of disparities farther apart than a window
give another, which includes the effect of the window shape; the larger of both is taken.
If noise dominates, the step is repeated with larger windows, as long as they contain one surface.
Semi-global matching uses grey values minus their means over large windows, with equal contrast,
since exposures differ.

Sources: Hirschmüller (2008); Lucas and Kanade (1981); Ackermann (1984).
"""

import dataclasses
from concurrent.futures import ThreadPoolExecutor
from typing import Protocol

import numpy as np
from jaxtyping import Bool, Float
from scipy import ndimage

from jaxbundle.photographs.opencv import need_opencv
from jaxbundle.surface.scatter import robust_factor, scatter_factor
from jaxbundle.system.configuration import available_cores

BLOCK = 3
"""Side of the blocks of semi-global matching."""
MEAN_WINDOW = 40
"""Half the side of the windows whose means are subtracted from the grey values."""
LEAST_SPREAD = 25.0
"""Minimum standard deviation of compared grey values, of 256."""
MOST_COSTS = 4e8
"""Pixels times disparities up to which all costs, of 2 bytes and more, are held in memory, and
paths from below are also followed."""
STRIP_MARGIN = 128
"""Rows above and below a strip that are matched with it: paths begin there."""
UNIQUENESS = 5
"""Percent by which the best cost must be below the second."""
SMALLEST_REGION = 80
"""Pixels of the smallest region of similar disparities that is kept."""
HALF, WIDE = 4, 7
"""Half the side of the windows of least squares; of those where the texture is weak."""
WEAK, FEW = 0.05, 0.02
"""σ of a disparity, pixels, above which the texture is weak; the share of weak pixels below which
no larger windows are tried."""
MOST_RATIO = 5.0
"""Maximum ratio of the contrasts of two windows that may be alike."""
ROUNDS = 2
BAND, MARGIN = 128, 32
"""Rows refined together, and rows above and below covered by their windows."""
HOLES, STEP, JUMP = 0.5, 0.3, 2.5
"""Pixels: σ that a window has of gaps, by the root of their share; and of a step in the surface,
which is a change of disparities by more than `JUMP`. Found on rendered roofs."""
BLOCK_SIDE, SMOOTHEST = 48, 0.25
"""Pixels of a block for the scatter; the quantile of the blocks used."""
COARSER, REPEATED, REPETITION, SMALL = 4, 4, 0.8, 0.02
"""Reduction factor; half the side of windows compared with others of the same image; correlation
from which the texture repeats itself; minimum part of the image for a surface of such a texture."""
SURFACE_TOLERANCE = 0.7
"""Approximate difference of disparities of one surface within a window, pixels."""
MOST_CHANGE = 1.0
"""Maximum change of a disparity by least squares, pixels."""
LEAST_CORRELATION, SURE = 0.5, 0.9
"""Minimum ρ of a window; and of one beside a step in the surface."""
LEAST_SIGMA, MOST_SIGMA = 0.008, 0.5
"""σ of a disparity, pixels: added by interpolation and sampling, and the limit above which the
texture does not determine it."""
INNER, SIGNIFICANT = 2, 3.0
"""Margin of the window around its middle, which must have texture of its own: variance above that
of noise by this many σ. Otherwise the window shows the surroundings of its pixel."""
LEAST_CONTRAST = 1.0
"""Standard deviation of a window, grey values of 256."""


class RowPair(Protocol):
    """Two images whose epipolar lines are rows; NaN outside."""

    @property
    def left(self) -> Float[np.ndarray, "rows columns"]: ...

    @property
    def right(self) -> Float[np.ndarray, "rows columns"]: ...


@dataclasses.dataclass(frozen=True)
class Disparities:
    """Disparity, its σ (times the root of `factor`), ρ of the window; NaN: none."""

    disparity: Float[np.ndarray, "rows columns"]
    sigma: Float[np.ndarray, "rows columns"]
    rho: Float[np.ndarray, "rows columns"]
    factor: float


def match_dense(pair: RowPair, span: int) -> Disparities:
    """Disparities from 0 to `span` of a rectified pair, at the pixels of its left image."""
    left, right = _prepare(pair)
    inside = np.isfinite(pair.left)
    even, right_even = alike(left, right, inside, np.isfinite(pair.right))
    start = semi_global(even, right_even, span)
    start[~inside] = np.nan
    start[ambiguous(left, start, span)] = np.nan
    return refine_disparities(left, right, start)


def alike(left, right, inside, right_inside) -> list[Float[np.ndarray, "rows columns"]]:
    """Grey values around 128 without differences of exposure and light."""
    cv2 = need_opencv()
    mean = lambda a: cv2.blur(a.astype(np.float32), (2 * MEAN_WINDOW + 1,) * 2)
    found, spread = [], 0.0
    for a, there in ((left, inside), (right, right_inside)):
        away = np.where(there, a - mean(a * there) / np.maximum(mean(there), 1e-6), 0)
        own = float(np.std(away[there])) if there.any() else 0.0
        spread = spread or max(own, LEAST_SPREAD)
        found.append(np.clip(128 + away * (spread / max(own, 1.0)), 0, 255).astype(np.float32))
    return found


def semi_global(left, right, span: int) -> Float[np.ndarray, "rows columns"]:
    """Disparities by OpenCV, pixels; NaN if removed by the left-right check, the uniqueness or the
    speckle filter. OpenCV follows the paths of a large image on one core: it is matched in strips
    of rows, one for each core."""
    cv2 = need_opencv()
    number = max(16, -(-(span + 1) // 16) * 16)
    large, rows = left.size * number >= MOST_COSTS, len(left)
    mode = cv2.STEREO_SGBM_MODE_SGBM if large else cv2.STEREO_SGBM_MODE_HH4
    eight = [np.clip(np.rint(a), 0, 255).astype(np.uint8) for a in (left, right)]
    # columns of the left image without a full range of disparities are matched with a margin
    wide = [cv2.copyMakeBorder(a, 0, 0, number, 0, cv2.BORDER_REPLICATE) for a in eight]
    strip = -(-rows // available_cores()) if large else rows

    def of_strip(first):
        low, high = max(first - STRIP_MARGIN, 0), min(first + strip + STRIP_MARGIN, rows)
        matcher = cv2.StereoSGBM.create(
            minDisparity=0, numDisparities=number, blockSize=BLOCK, P1=8 * BLOCK**2,
            P2=48 * BLOCK**2, disp12MaxDiff=1, preFilterCap=31, uniquenessRatio=UNIQUENESS,
            speckleWindowSize=SMALLEST_REGION, speckleRange=2, mode=mode,
        )  # fmt: skip
        found = matcher.compute(*(np.ascontiguousarray(a[low:high]) for a in wide))
        return found[first - low : first - low + strip, number:]

    with ThreadPoolExecutor(available_cores()) as pool:
        found = np.concatenate([*pool.map(of_strip, range(0, rows, strip))])
    found = found.astype(np.float32) / 16
    return np.where((found >= 0) & (found <= span), found, np.nan)


def ambiguous(
    left: Float[np.ndarray, "rows columns"], disparity: Float[np.ndarray, "rows columns"], span: int
) -> Bool[np.ndarray, "rows columns"]:
    """Pixels whose texture repeats itself along the row within the range of disparities, on a small
    separate surface: parts visible in one image only match the repetition in the other."""
    cv2 = need_opencv()
    rows, columns = (n // COARSER for n in left.shape)
    coarse = cv2.resize(left, (columns, rows), interpolation=cv2.INTER_AREA)
    repeated = _likeness(coarse, span // COARSER) > REPETITION
    if not repeated.any():
        return np.zeros(left.shape, bool)
    repeated = cv2.resize(repeated.astype(np.uint8), left.shape[::-1],
                          interpolation=cv2.INTER_NEAREST) > 0  # fmt: skip
    known = np.isfinite(disparity)
    whole = np.where(known, 16 * np.nan_to_num(disparity), -16).astype(np.int16)
    kept, _ = cv2.filterSpeckles(whole, -16, int(SMALL * left.size), 16)
    return known & repeated & (kept < 0)


def _likeness(a, farthest):
    """The greatest correlation of each window with one on its row, no farther away."""
    cv2 = need_opencv()
    side = (2 * REPEATED + 1, 2 * REPEATED + 1)
    mean = lambda x: cv2.boxFilter(x, -1, side)
    a = a - a.mean()
    m = mean(a)
    spread = np.sqrt(np.maximum(mean(a * a) - m * m, 1e-3))
    best = np.full(a.shape, -1.0, np.float32)
    for lag in range(REPEATED, farthest + 1):
        rho = mean(a[:, lag:] * a[:, :-lag]) - m[:, lag:] * m[:, :-lag]
        rho /= spread[:, lag:] * spread[:, :-lag]
        np.maximum(best[:, lag:], rho, out=best[:, lag:])
        np.maximum(best[:, :-lag], rho, out=best[:, :-lag])
    return best


def refine_disparities(left, right, start) -> Disparities:
    """Least squares at every pixel with a disparity."""
    coefficients = ndimage.spline_filter(right, 3, np.float32)
    known = np.isfinite(start)
    found, stepped = _with_windows(left, coefficients, start, HALF, known)
    with np.errstate(invalid="ignore"):
        weak = known & ~(found.sigma < WEAK) & ~stepped
    if weak.sum() > FEW * known.sum():
        wide, over_step = _with_windows(left, coefficients, start, WIDE, weak)
        with np.errstate(invalid="ignore"):
            better = weak & ~over_step & (wide.sigma < np.nan_to_num(found.sigma, nan=MOST_SIGMA))
        mixed = {name: np.where(better, getattr(wide, name), getattr(found, name))
                 for name in ("disparity", "sigma", "rho")}  # fmt: skip
        found = dataclasses.replace(found, **mixed)
    return found


def _with_windows(left, coefficients, start, half, wanted):
    """Disparities by windows of 2·`half` + 1 pixels, with the factor of those wanted in σ; which
    windows have a step of the surface in them."""
    rows = len(left)

    def of_rows(first):
        low, high = max(first - MARGIN, 0), min(first + BAND + MARGIN, rows)
        found = _refine(left[low:high], coefficients[low:high], start[low:high], half)
        return [a[first - low : first - low + BAND] for a in found]

    with ThreadPoolExecutor(available_cores()) as pool:
        bands = list(pool.map(of_rows, range(0, rows, BAND)))
    d, sigma, rho, across = (np.concatenate(parts) for parts in zip(*bands))
    good = np.isfinite(d)
    smooth = scatter_factor(np.where(wanted, d, np.nan), sigma, 2 * half + 1, BLOCK_SIDE, SMOOTHEST)
    factor = max(robust_factor(across[good & wanted]), min(smooth, default=1.0))
    edges = _at_edges(np.where(good, d, 0), good, half)
    sigma = np.sqrt(factor * sigma**2 + LEAST_SIGMA**2 + edges)
    stepped = edges >= STEP**2
    with np.errstate(invalid="ignore"):
        # beside a step the disparities of one side extend to the other
        good &= ~stepped | (rho >= SURE)
        good &= sigma < MOST_SIGMA
    keep = lambda a: np.where(good, a, np.nan)
    return Disparities(keep(d), keep(sigma), keep(rho), factor), stepped


def _refine(left, coefficients, start, half):
    """Disparities (NaN: none), their σ, ρ, and shifts across the rows over their σ, of some rows;
    `coefficients`: of the spline through the right image."""
    known = np.isfinite(start)
    shape = _smooth(_without_noise(start, known), known, half)
    y, x = np.indices(left.shape, dtype=np.float32)
    found, moved = None, np.zeros(left.shape, np.float32)
    for last in range(ROUNDS):
        if last:
            # a smooth shape and the windows' mean of what is left of it: no bias from curvature
            shape = _smooth(np.where(known, shape + moved, np.nan), known, half)
        warped = ndimage.map_coordinates(
            coefficients, [y, x - np.where(known, shape, 0)], order=3, prefilter=False,
            mode="nearest",
        )  # fmt: skip
        found = _solve(left, warped, half)
        moved = np.clip(np.nan_to_num(found.x), -MOST_CHANGE, MOST_CHANGE).astype(np.float32)
    assert found is not None
    with np.errstate(invalid="ignore", divide="ignore"):
        good = known & (np.abs(shape + moved - start) <= MOST_CHANGE) & (np.abs(found.x) < 0.5)
        good &= (found.rho >= LEAST_CORRELATION) & found.textured & (found.h1 > 0.2)
        across = found.y / found.sigma_y
    d = np.where(good, shape + moved, np.nan).astype(np.float32)
    return d, found.sigma_x.astype(np.float32), found.rho.astype(np.float32), across.astype(
        np.float32
    )


@dataclasses.dataclass(frozen=True)
class _Solved:
    x: np.ndarray
    y: np.ndarray
    sigma_x: np.ndarray
    sigma_y: np.ndarray
    rho: np.ndarray
    h1: np.ndarray
    textured: Bool[np.ndarray, "rows columns"]


def _solve(left, warped, half) -> _Solved:
    """δ, ε, h₁ and their σ from sums over windows."""
    cv2 = need_opencv()
    side = 2 * half + 1
    n = side * side
    mean = lambda a: cv2.boxFilter(a, cv2.CV_64F, (side, side), borderType=cv2.BORDER_REFLECT_101)
    m = {"L": mean(left), "R": mean(warped)}
    product = lambda a, b, i, j: n * (mean(a * b) - m[i] * m[j])
    LL, RR = product(left, left, "L", "L"), product(warped, warped, "R", "R")
    # gradients in grey values of the left image, for any exposure of the right one
    ratio = np.sqrt(np.maximum(LL, n) / np.maximum(RR, n)).clip(1 / MOST_RATIO, MOST_RATIO)
    gradient = lambda axis: (_gradient(left, axis) + ratio * _gradient(warped, axis)) / 2
    # the disparity moves the right image against its columns: −∂R/∂x
    gx, gy = -gradient(1), gradient(0)
    m |= {"x": mean(gx), "y": mean(gy)}
    table = {"R": warped, "x": gx, "y": gy}
    names = ("x", "y", "R")
    N = np.empty((*left.shape, 3, 3))
    g = np.empty((*left.shape, 3))
    for i, a in enumerate(names):
        for j, b in enumerate(names[: i + 1]):
            N[..., i, j] = N[..., j, i] = product(table[a], table[b], a, b)
        g[..., i] = product(table[a], left, a, "L")
    LR = g[..., 2]
    textured = (LL > n * LEAST_CONTRAST**2) & (RR > n * LEAST_CONTRAST**2)
    inner = _variance(left, half // INNER)
    Q, p = _invert_normal(N, g, textured)
    rest = np.maximum(LL - np.einsum("...i,...i->...", p, g), 0)
    s2 = rest / (n - 4)
    # half of s² is the noise of the left image
    beyond = 1 + SIGNIFICANT * np.sqrt(2 / ((2 * (half // INNER) + 1) ** 2 - 1))
    textured &= inner > LEAST_CONTRAST**2 + beyond * s2 / 2
    with np.errstate(invalid="ignore", divide="ignore"):
        rho = LR / np.sqrt(LL * RR)
        h1 = p[..., 2]
        sigma = [np.sqrt(s2 * Q[..., k, k]) for k in (0, 1)]
    return _Solved(p[..., 0], p[..., 1], sigma[0], sigma[1], rho, h1, textured)


def _variance(a, half):
    """Variance of the grey values of windows."""
    cv2 = need_opencv()
    side = (2 * half + 1, 2 * half + 1)
    mean = lambda x: cv2.boxFilter(x, cv2.CV_64F, side, borderType=cv2.BORDER_REFLECT_101)
    return mean(a * a) - mean(a) ** 2


def _invert_normal(N, g, textured):
    """N⁻¹ and N⁻¹·g of symmetric 3 × 3; NaN where there is no texture or one direction has none."""
    a, b, c = N[..., 0, 0], N[..., 0, 1], N[..., 0, 2]
    d, e, f = N[..., 1, 1], N[..., 1, 2], N[..., 2, 2]
    A, B, C = d * f - e * e, c * e - b * f, b * e - c * d
    D, E, F = a * f - c * c, b * c - a * e, a * d - b * b
    determinant = a * A + b * B + c * C
    good = textured & (determinant > 1e-9 * a * d * f) & (a * d * f > 0)
    with np.errstate(invalid="ignore", divide="ignore"):
        Q = np.stack([A, B, C, B, D, E, C, E, F], -1).reshape(*a.shape, 3, 3)
        Q = np.where(good[..., None, None], Q / determinant[..., None, None], np.nan)
    return Q, np.einsum("...ij,...j->...i", Q, g)


def _gradient(a, axis):
    """Derivative of the cubic spline through the pixels' neighbours (fourth order central
    difference)."""
    kernel = np.array([1, -8, 0, 8, -1], np.float32) / 12
    return ndimage.correlate1d(a, kernel, axis=axis, mode="nearest")


def _at_edges(d, known, half):
    """The added variance of a window that extends beyond the surface: with pixels without
    disparity, or of another surface."""
    cv2 = need_opencv()
    window = (2 * half + 1, 2 * half + 1)
    holes = cv2.boxFilter((~known).astype(np.float32), -1, window)
    high = cv2.dilate(np.where(known, d, -1e4).astype(np.float32), np.ones(window, np.uint8))
    low = cv2.erode(np.where(known, d, 1e4).astype(np.float32), np.ones(window, np.uint8))
    return HOLES**2 * holes + STEP**2 * (known & (high - low > JUMP))


def _without_noise(disparity, known):
    """Medians of 5 × 5, if they are near."""
    cv2 = need_opencv()
    median = cv2.medianBlur(np.where(known, disparity, -1e3).astype(np.float32), 5)
    with np.errstate(invalid="ignore"):
        return np.where(np.abs(median - disparity) < 1.5, median, disparity)


def _smooth(disparity, known, half):
    """Means of the similar disparities in a window."""
    cv2 = need_opencv()
    far = np.where(known, disparity, -1e3).astype(np.float32)
    smooth = cv2.bilateralFilter(far, 2 * half + 1, SURFACE_TOLERANCE, float(half))
    return np.where(known, smooth, np.nan).astype(np.float32)


def _prepare(pair: RowPair):
    """Both images between 0 and 255, without gaps."""
    grey = [a[np.isfinite(a)] for a in (pair.left, pair.right)]
    if not all(len(g) for g in grey):
        return np.zeros_like(pair.left), np.zeros_like(pair.left)
    values = np.concatenate([g[:: max(1, len(g) // 200_000)] for g in grey])
    low, high = (0.0, 255.0) if values.max() <= 260 and values.min() >= -5 else (
        np.percentile(values, [0.2, 99.8])
    )
    scale = 255 / max(high - low, 1e-9)
    left, right = (np.where(np.isfinite(a), (a - low) * scale, 0).astype(np.float32)
                   for a in (pair.left, pair.right))  # fmt: skip
    return left, right
