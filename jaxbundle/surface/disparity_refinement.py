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
from jaxtyping import Float
from scipy import ndimage

from jaxbundle.photographs.opencv import need_opencv
from jaxbundle.surface.row_windows import correct
from jaxbundle.surface.scatter import missing_sigma, robust_factor
from jaxbundle.system.configuration import available_cores

HALF, WIDE = 4, 7
"""Half the side of the windows of least squares; of those where the texture is weak."""
WEAK, FEW = 0.05, 0.02
"""σ of a disparity, pixels, above which the texture is weak; the share of weak pixels below which
no larger windows are tried."""
ROUNDS = 2
PIECE = 256, 512
"""Rows and columns refined together, with their margins: few enough for a processor's cache."""
HOLES, STEP, JUMP = 0.5, 0.3, 2.5
"""Pixels: σ that a window has of gaps, by the root of their share; and of a step in the surface,
which is a change of disparities by more than `JUMP`. Found on rendered roofs."""
BLOCK_SIDE, SMOOTHEST = 48, 0.25
"""Pixels of a block for the scatter; the quantile of the blocks used."""
SURFACE_TOLERANCE = 0.7
"""Approximate difference of disparities of one surface within a window, pixels."""
MOST_CHANGE, LAST_CHANGE = 1.0, 0.5
"""Maximum change of a disparity by least squares, in all and by the last round, pixels."""
LEAST_CORRELATION, SURE = 0.5, 0.9
"""Minimum ρ of a window; and of one beside a step in the surface."""
LEAST_RATIO = 0.2
"""Minimum ratio of the contrasts of both windows."""
LEAST_SIGMA, MOST_SIGMA = 0.014, 0.5
"""σ of a disparity, pixels: added by interpolation and sampling (errors that depend on the fraction
of the disparity are alike over whole surfaces: no scatter shows them), and the limit above which
the texture does not determine it."""


@dataclasses.dataclass(frozen=True)
class Disparities:
    """Disparity, its σ, ρ of the window; NaN: none. `factor`: of the variances of matching, which
    σ contains."""

    disparity: Float[np.ndarray, "rows columns"]
    sigma: Float[np.ndarray, "rows columns"]
    rho: Float[np.ndarray, "rows columns"]
    factor: float


def refine_disparities(
    left: Float[np.ndarray, "rows columns"],
    right: Float[np.ndarray, "rows columns"],
    start: Float[np.ndarray, "rows columns"],
) -> Disparities:
    """Least squares at every pixel with a disparity."""
    spline = _Spline.through(right)
    known = np.isfinite(start)
    found, stepped = _with_windows(left, spline, start, HALF, known)
    with np.errstate(invalid="ignore"):
        weak = known & ~(found.sigma < WEAK) & ~stepped
    if weak.sum() > FEW * known.sum():
        wide, over_step = _with_windows(left, spline, start, WIDE, weak)
        with np.errstate(invalid="ignore"):
            better = weak & ~over_step & (wide.sigma < np.nan_to_num(found.sigma, nan=MOST_SIGMA))
        mixed = {
            name: np.where(better, getattr(wide, name), getattr(found, name))
            for name in ("disparity", "sigma", "rho")
        }
        found = dataclasses.replace(found, **mixed)
    return found


class _Spline(NamedTuple):
    """Coefficients of the cubic splines along the rows of an image, two more at each end."""

    coefficients: Float[np.ndarray, "rows more_columns"]

    @classmethod
    def through(cls, image) -> "_Spline":
        rows = ndimage.spline_filter1d(image, 3, axis=1, output=np.float32)
        return cls(np.pad(rows, [(0, 0), (2, 2)], mode="reflect"))

    def at(self, rows, columns, disparity) -> Float[np.ndarray, "rows columns"]:
        """Grey values to the left of some rows and columns by the disparities; those of the edge
        beyond it."""
        whole = np.floor(-disparity)
        t = -disparity - whole
        first = columns + whole.astype(np.int32)
        last = self.coefficients.shape[1] - 5
        t = np.where((first < 0) | (first >= last), 0, t)
        first = np.clip(first, 0, last) + self.coefficients.shape[1] * rows[:, None]
        flat = self.coefficients.ravel()
        t2, t3 = t * t, t * t * t
        weights = 1 - 3 * t + 3 * t2 - t3, 4 - 6 * t2 + 3 * t3, 1 + 3 * (t + t2 - t3), t3
        found = np.zeros(first.shape, np.float32)
        for k, weight in enumerate(weights):
            found += weight * flat.take(first + k + 1)
        return found / 6


def _with_windows(left, spline, start, half, wanted):
    """Disparities by windows of 2·`half` + 1 pixels, with the factor of those wanted in σ; which
    windows have a step of the surface in them."""
    rows, columns = left.shape
    margin = 4 * (half + 1)
    height, width = (n - 2 * margin for n in PIECE)
    d, sigma, rho, across = (np.full(left.shape, np.nan, np.float32) for _ in range(4))

    def refine(corner):
        inner = tuple(slice(k, k + n) for k, n in zip(corner, (height, width)))
        if not wanted[inner].any():
            return
        v, u = (
            _reflect(np.arange(n) + k - margin, size)
            for k, n, size in zip(corner, PIECE, left.shape)
        )
        found = _refine(left, spline, start, v, u, half)
        for out, piece in zip((d, sigma, rho, across), found):
            place = out[inner]
            place[:] = piece[margin:, margin:][: place.shape[0], : place.shape[1]]

    corners = [(r, c) for r in range(0, rows, height) for c in range(0, columns, width)]
    with ThreadPoolExecutor(available_cores()) as pool:
        list(pool.map(refine, corners))
    good = np.isfinite(d)
    factor, noise = _estimate_noise(np.where(wanted, d, np.nan), sigma, across, half)
    edges = _at_edges(np.where(good, d, 0), good, half)
    sigma = np.sqrt(noise**2 + edges)
    stepped = edges >= STEP**2
    with np.errstate(invalid="ignore"):
        # beside a step the disparities of one side extend to the other
        good &= ~stepped | (rho >= SURE)
        good &= sigma < MOST_SIGMA
    keep = lambda a: np.where(good, a, np.nan)
    return Disparities(keep(d), keep(sigma), keep(rho), factor), stepped


def _estimate_noise(d, sigma, across, half):
    """The variance factor, and σ of the disparities d."""
    factor = robust_factor(across[np.isfinite(d)])
    noise = np.hypot(np.sqrt(factor) * sigma, LEAST_SIGMA)
    shape = missing_sigma(d, noise, np.ones_like(noise), 2 * half + 1, BLOCK_SIDE, SMOOTHEST)
    if shape is not None:
        return factor, np.hypot(noise, shape)
    factor = max(factor, 1.0)
    return factor, np.hypot(np.sqrt(factor) * sigma, LEAST_SIGMA)


def _reflect(index, n):
    """Indices beyond the ends, reflected at the first and the last of `n`."""
    period = max(2 * (n - 1), 1)
    return (n - 1) - np.abs((n - 1) - index % period)


def _refine(left, spline, start, rows, columns, half):
    """Disparities (NaN: none), their σ, ρ, and shifts across the rows over their σ, of some rows
    and columns."""
    piece = np.ix_(rows, columns)
    left, start = left[piece], start[piece]
    known = np.isfinite(start)
    shape = _smooth(_without_noise(start, known), known, half)
    moved = np.zeros_like(shape)
    for last in range(ROUNDS):
        if last:
            # a smooth shape and the windows' mean of what is left of it: no bias from curvature
            shape = _smooth(np.where(known, shape + moved, np.nan), known, half)
        right = spline.at(rows, columns, np.where(known, shape, 0))
        found = correct(left, right, half)
        delta, sigma, across, rho, contrast, textured = (np.asarray(a) for a in found)
        moved = np.clip(np.nan_to_num(delta), -MOST_CHANGE, MOST_CHANGE)
    with np.errstate(invalid="ignore"):
        good = known & (np.abs(shape + moved - start) <= MOST_CHANGE)
        good &= (np.abs(delta) < LAST_CHANGE) & (rho >= LEAST_CORRELATION)
        good &= textured & (contrast > LEAST_RATIO)
    return np.where(good, shape + moved, np.nan), sigma, rho, across


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
    # OpenCV tabulates the weights between the smallest and the largest value: not too far apart
    far = np.min(disparity, initial=np.inf, where=known) - 10 * SURFACE_TOLERANCE
    filled = np.where(known, disparity, far if known.any() else 0.0).astype(np.float32)
    smooth = cv2.bilateralFilter(filled, 2 * half + 1, SURFACE_TOLERANCE, float(half))
    return np.where(known, smooth, np.nan).astype(np.float32)
