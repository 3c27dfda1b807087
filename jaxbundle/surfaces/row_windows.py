"""Least squares of windows along rows, at every pixel of a piece of a rectified pair.

With R the right image, moved by the disparities found so far,

    left + v = h₀ + h₁·R + g_x·δ + g_y·ε

is solved for a correction δ of the disparity, a shift ε across the rows, brightness and contrast.
All sums are over the known pixels of windows, relative to their means: OpenCV's box filters, whose
time does not depend on the size of the window. They are of single precision, so the mean of the
piece is subtracted first.

Sources: Lucas and Kanade (1981); Ackermann (1984).
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float32

from jaxbundle.photographs.opencv import need_opencv

Piece = Float32[np.ndarray, "rows columns"]
PieceMask = Bool[np.ndarray, "rows columns"]


class RowCorrections(NamedTuple):
    """δ, its σ, ε over its σ, ρ of the window, h₁ (NaN: not determined), and the variance of the
    grey values' noise in one image."""

    delta: Piece
    sigma: Piece
    normalised_row_shift: Piece
    rho: Piece
    contrast: Piece
    noise: Piece


class RowWindows:
    """Both images of a piece, the right one moved, and the products of their grey values and
    gradients; `correct` sums them over windows of any size."""

    def __init__(self, left: Piece, right: Piece, is_known: PieceMask) -> None:
        offset = np.float32(left[is_known].mean() if is_known.any() else 0.0)
        self.weight = is_known.astype(np.float32)
        L, R = left - offset, right - offset
        ratio = self._contrast_ratio(L, R)
        # Gradients in grey values of the left image, for any exposure of the right one; the
        # disparity moves the right image against its columns: −∂R/∂x.
        x, y = (-0.5 * (_gradient(L, axis) + ratio * _gradient(R, axis)) for axis in (1, 0))
        self.left = L
        L, R, x, y = (a * self.weight for a in (L, R, x, y))
        self.first = {"L": L, "R": R, "x": x, "y": y}
        self.second = {
            "LL": L * L,
            "RR": R * R,
            "LR": L * R,
            "xx": x * x,
            "xy": x * y,
            "xR": x * R,
            "yy": y * y,
            "yR": y * R,
            "xL": x * L,
            "yL": y * L,
        }

    def _contrast_ratio(self, L: Piece, R: Piece) -> Piece:
        """Contrast of the left image by that of the right one, in windows of 15 × 15 pixels,
        limited, since noise decides it where there is no texture (half and double of the limit: no
        difference)."""
        half_window, limit = 7, 5.0
        n = np.maximum(_sum_windows(self.weight, half_window), 1)
        # At least a standard deviation of one grey value.
        LL, RR = (
            np.maximum(
                _sum_windows(self.weight * a * a, half_window) / n
                - (_sum_windows(self.weight * a, half_window) / n) ** 2,
                1.0,
            )
            for a in (L, R)
        )
        return np.clip(np.sqrt(LL / RR), 1 / limit, limit)

    def correct(self, half_window: int) -> RowCorrections:
        """Corrections by windows of 2·`half_window` + 1 pixels, those at the edges continued by
        reflection."""
        n = np.maximum(_sum_windows(self.weight, half_window), 1)
        mean = {name: _sum_windows(a, half_window) / n for name, a in self.first.items()}
        # Moments about the means of the windows, times the number of their pixels.
        moment = lambda name: (
            _sum_windows(self.second[name], half_window) - n * mean[name[0]] * mean[name[1]]
        )
        LL, f, LR = moment("LL"), moment("RR"), moment("LR")
        a, b, c, d, e = (moment(name) for name in ("xx", "xy", "xR", "yy", "yR"))
        g = moment("xL"), moment("yL"), LR
        # Unrolled: a batched solver of 3 × 3 systems would need all pixels' matrices as one array.
        # The inverse of the symmetric matrix of a, b, c; d, e; f
        A, B, C = d * f - e * e, c * e - b * f, b * e - c * d
        D, E, F = a * f - c * c, b * c - a * e, a * d - b * b
        determinant = a * A + b * B + c * C
        # A standard deviation of 1 grey value of 256: less is rounding. Half of a window must be
        # known. The determinant is 0 for a texture of one direction; its limit is not critical,
        # since σ, which grows with the inverse of the determinant, is tested as well.
        min_variance, scale = 1.0, a * d * f
        good = (
            (LL > n * min_variance) & (f > n * min_variance) & (2 * n > (2 * half_window + 1) ** 2)
        )
        good &= (determinant > 1e-9 * scale) & (scale > 0)
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            inverse = 1 / np.where(good, determinant, np.float32(np.nan))
            delta, epsilon, contrast = (
                (u * g[0] + v * g[1] + w * g[2]) * inverse
                for u, v, w in ((A, B, C), (B, D, E), (C, E, F))
            )
            unexplained = np.maximum(LL - delta * g[0] - epsilon * g[1] - contrast * g[2], 0)
            variance = unexplained / (n - 4)
            return RowCorrections(
                delta,
                np.sqrt(variance * A * inverse),
                epsilon / np.sqrt(variance * D * inverse),
                LR / np.sqrt(LL * f),
                contrast,
                variance / 2,  # the other half is the noise of the right image
            )

    def find_own_texture(self, half_window: int, noise: Piece) -> PieceMask:
        """Windows whose middle has texture of its own, as have their four sides: others show the
        surroundings of their pixel, such as the ground beside a roof without texture."""
        min_variance = 1.0
        inner = half_window // 2
        number = (2 * inner + 1) ** 2
        L = self.left
        middle = _sum_windows(L * L, inner) / number - (_sum_windows(L, inner) / number) ** 2
        side = half_window * (2 * half_window + 1)
        with np.errstate(invalid="ignore"):
            has_texture = middle > min_variance + _noise_limit(number) * noise
            return has_texture & (_min_side_variance(L, half_window) > _noise_limit(side) * noise)


def _sum_windows(a: Piece, half_window: int) -> Piece:
    cv2 = need_opencv()
    window = (2 * half_window + 1, 2 * half_window + 1)
    return cv2.boxFilter(a, cv2.CV_32F, window, normalize=False, borderType=cv2.BORDER_REFLECT_101)


def _noise_limit(number: int) -> float:
    """Ratio of the variance of some grey values to that of noise, above which they have texture:
    noise exceeds it in less than 1 % of the windows.

    The variance of n values of normal noise has the relative standard deviation √(2/(n − 1)); three
    of them are allowed."""
    return 1 + 3.0 * float(np.sqrt(2 / (number - 1)))


def _min_side_variance(a: Piece, half_window: int) -> Piece:
    """The smallest variance of the four sides of each window, without its middle row and column."""
    cv2 = need_opencv()
    rows, columns = a.shape
    wide = cv2.copyMakeBorder(
        a, half_window, half_window, half_window, half_window, cv2.BORDER_REFLECT_101
    )
    smallest = np.full(a.shape, np.inf, np.float32)
    for window in ((2 * half_window + 1, half_window), (half_window, 2 * half_window + 1)):
        mean, square = (
            cv2.boxFilter(x, cv2.CV_32F, window, anchor=(0, 0), borderType=cv2.BORDER_REFLECT_101)
            for x in (wide, wide * wide)
        )
        variance = square - mean * mean
        # From the first pixel of the window, and from the one after its middle.
        down, right = (half_window + 1, 0) if window[1] == half_window else (0, half_window + 1)
        for r, c in ((0, 0), (down, right)):
            np.minimum(smallest, variance[r : r + rows, c : c + columns], out=smallest)
    return smallest


def _gradient(a: Piece, axis: int) -> Piece:
    """Derivative of the cubic polynomial through two neighbours on each side (central difference of
    fourth order)."""
    cv2 = need_opencv()
    difference = np.array([1, -8, 0, 8, -1], np.float32) / 12
    identity = np.ones(1, np.float32)
    along = (difference, identity) if axis == 1 else (identity, difference)
    return cv2.sepFilter2D(a, cv2.CV_32F, *along, borderType=cv2.BORDER_REPLICATE)
