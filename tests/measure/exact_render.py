"""Photographs of flat patterns under a homography, area-averaged: known to a thousandth of a pixel.

The plane is divided `FINE` times finer than the pixels; the grey value of a fine pixel is the mean
of the pattern over its footprint, from a summed-area table of the cells (`Cells`) or from distances
to the rims (`Discs`). The fine image is blurred by a Gaussian, averaged over the pixels, given
noise, and rounded to 8 bits. Pixel (0, 0) is the centre of the upper left pixel.
"""

from dataclasses import dataclass

import cv2
import numpy as np

FINE = 4


@dataclass(frozen=True)
class Cells:
    """Square cells of side 1 with brightness `table` [rows, columns], x right, y down from the
    upper left corner; `around`: brightness beyond them."""

    table: np.ndarray
    around: float = 0.5

    def mean(self, x, y, half_x, half_y):
        """Means over the boxes x ± half_x, y ± half_y."""
        rows, columns = self.table.shape
        above = np.zeros((rows + 1, columns + 1))
        above[1:, 1:] = (np.asarray(self.table, float) - self.around).cumsum(0).cumsum(1)

        def integral(x, y):
            x, y = np.clip(x, 0, columns), np.clip(y, 0, rows)
            i, j = np.minimum(y.astype(int), rows - 1), np.minimum(x.astype(int), columns - 1)
            u, v = x - j, y - i
            upper = above[i, j] * (1 - u) + above[i, j + 1] * u
            return upper * (1 - v) + v * (above[i + 1, j] * (1 - u) + above[i + 1, j + 1] * u)

        low, high = (x - half_x, y - half_y), (x + half_x, y + half_y)
        total = integral(*high) - integral(low[0], high[1]) - integral(high[0], low[1])
        return self.around + (total + integral(*low)) / (4 * half_x * half_y)


@dataclass(frozen=True)
class Rings:
    """Sectors of rings about points: rows (x, y, inner radius, outer radius, first angle, last
    angle, brightness), on a ground of one brightness; later ones cover earlier ones."""

    parts: tuple[tuple[float, ...], ...]
    ground: float = 1.0

    def mean(self, x, y, half_x, half_y):
        """As `Cells.mean`, from the distances of the boxes' centres from the rims."""
        out, all_sizes = np.full(np.shape(x), self.ground), np.maximum(half_x, half_y) * 2
        for cx, cy, inner, outer, first, last, value in self.parts:
            reach = outer * 1.1
            near = np.nonzero((np.abs(x - cx) < reach) & (np.abs(y - cy) < reach))
            u, v, size = x[near] - cx, y[near] - cy, all_sizes[near]
            r = np.hypot(u, v)
            cover = np.clip((outer - r) / size + 0.5, 0, 1)
            if inner:
                cover *= np.clip((r - inner) / size + 0.5, 0, 1)
            if last - first < 2 * np.pi:
                t = (np.arctan2(v, u) - (first + last) / 2 + np.pi) % (2 * np.pi) - np.pi
                cover *= np.clip(((last - first) / 2 - np.abs(t)) * r / size + 0.5, 0, 1)
            out[near] += cover * (value - out[near])
        return out


def photograph(pattern, H, size, blur=0.7, noise=1.5, levels=(30.0, 220.0), gamma=1.0, seed=0):
    """The photograph [rows, columns], uint8, of a pattern; `H` [3, 3] from its plane to pixels;
    `size` (columns, rows); `levels`: grey values of brightness 0 and 1; `gamma`: exponent of the
    encoding of brightness in grey values."""
    columns, rows = size
    u = (np.arange(columns * FINE) + 0.5) / FINE - 0.5
    v = (np.arange(rows * FINE) + 0.5) / FINE - 0.5
    u, v = np.meshgrid(u, v)
    back = np.linalg.inv(H)
    x, y, w = (r[0] * u + r[1] * v + r[2] for r in back)
    x, y = x / w, y / w
    # the footprint of a fine pixel, as a box of the same second moments
    dx = np.hypot(back[0, 0] - back[2, 0] * x, back[0, 1] - back[2, 1] * x) / np.abs(w)
    dy = np.hypot(back[1, 0] - back[2, 0] * y, back[1, 1] - back[2, 1] * y) / np.abs(w)
    fine = pattern.mean(x, y, dx / (2 * FINE), dy / (2 * FINE))
    if blur:
        taps = 2 * int(4.5 * blur * FINE) + 1
        fine = cv2.GaussianBlur(fine, (taps, taps), blur * FINE, borderType=cv2.BORDER_REPLICATE)
    grey = np.clip(fine.reshape(rows, FINE, columns, FINE).mean((1, 3)), 0, 1)
    grey = levels[0] + (levels[1] - levels[0]) * grey ** (1 / gamma)
    grey = grey + noise * np.random.default_rng(seed).normal(size=grey.shape)
    return np.clip(np.rint(grey), 0, 255).astype(np.uint8)


def plane_to_pixels(
    side, tilt=0.0, turn=0.0, swing=0.0, middle=(0.0, 0.0), centre=(0.0, 0.0), distance=30.0
):
    """H of a plane seen from a `distance` in units: `side` pixels for each
    unit before tilting, tilted by `tilt` about the axis at `swing`, turned by `turn`, degrees;
    `centre` of the plane at `middle` in the photograph."""
    t, s, k = np.radians([tilt, swing, turn])
    about = lambda a: np.array([[np.cos(a), -np.sin(a), 0], [np.sin(a), np.cos(a), 0], [0, 0, 1]])
    lean = np.array([[1, 0, 0], [0, np.cos(t), -np.sin(t)], [0, np.sin(t), np.cos(t)]])
    R = about(k) @ about(s) @ lean @ about(-s)
    P = np.stack([R[:, 0], R[:, 1], [0, 0, distance]], 1)
    scale = np.diag([side * distance, side * distance, 1.0])
    shift = np.array([[1, 0, -centre[0]], [0, 1, -centre[1]], [0, 0, 1.0]])
    to = np.array([[1, 0, middle[0]], [0, 1, middle[1]], [0, 0, 1.0]])
    H = to @ scale @ P @ shift
    return H / H[2, 2]


def image_of(H, xy):
    """Image points [n, 2] of points [n, 2] of the plane."""
    return cv2.perspectiveTransform(np.asarray(xy, float)[None], H)[0]


def marker(dictionary, number, margin=1, around=0.5, inverted=False, border=1):
    """A marker with a white margin of whole cells, its upper left corner at (margin, margin), and
    its cells along a side."""
    words = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, dictionary))
    cells = words.markerSize + 2 * border
    table = cv2.aruco.generateImageMarker(words, number, cells, borderBits=border) / 255.0
    table = np.pad(table, margin, constant_values=1.0)
    return Cells(1 - table if inverted else table, around), cells
