"""A light or dark spot in a photograph: its window, its threshold, its pixels.

A window around the given position grows until it contains the nearest spot. Threshold within a
window: the grey value that separates two classes best (Otsu, 1979); the rim of the window
is background. The noise σg of the grey values is estimated by a mask that cancels
linear changes of the image (Immerkær, 1996).
"""

import dataclasses

import numpy as np
import scipy  # its parts are loaded on use

from jaxbundle.display import print_in_one_screen
from jaxbundle.errors import InputError

FIRST, LARGEST = 8, 256
"""Half a window, in pixels: the first, and the largest."""
CONTRAST = 5.0
"""Minimum difference of a target from its background, in σg."""
LEAST_CONTRAST = 4.0
"""Minimum difference of a target from its background, in grey values."""
LEAST_PIXELS = 5
MARGIN = 3
"""Pixels of the blurred edge beyond the spot."""


@print_in_one_screen
@dataclasses.dataclass(frozen=True)
class Spot:
    """A spot in its window: the window's corner (column, row) in the photograph, grey values, the
    pixels of the spot, and the levels."""

    corner: np.ndarray
    grey: np.ndarray
    inside: np.ndarray
    background: float
    level: float
    threshold: float
    noise: float

    @property
    def contrast(self) -> float:
        return self.level - self.background


def find_spot(grey, near) -> Spot:
    """The spot nearest to `near` (column, row) in `grey` [rows, columns].

    **Raises:** `InputError` if none stands out, or it is cut by the edge of the image.
    """
    where = f"at ({near[0]:.1f}, {near[1]:.1f})"
    rows, columns = grey.shape
    if not (0 <= near[0] < columns and 0 <= near[1] < rows):
        raise InputError(f"{where}: outside the image of {columns} × {rows} pixels")
    why = "no target stands out from its surroundings"
    half = FIRST
    while half <= LARGEST:
        low = np.maximum(np.rint(near).astype(int) - half, 0)
        high = np.minimum(np.rint(near).astype(int) + half + 1, [columns, rows])
        window = grey[low[1] : high[1], low[0] : high[0]]
        inside, threshold = _nearest_spot(window, near - low)
        if inside is not None:
            if _ends_inside(inside):
                return _levels(grey, low, window, inside, threshold)
            why = "the target reaches the edge of the image, or joins its surroundings"
        if (low == 0).all() and (high == [columns, rows]).all():
            break
        half *= 2
    raise InputError(f"{where}: {why}")


def _nearest_spot(window, near):
    """Pixels of the spot nearest to a position, and the threshold; None if there is none."""
    threshold = otsu(window)
    bright = window > threshold
    contrast = window[bright].mean() - window[~bright].mean() if bright.any() else 0.0
    if contrast < max(CONTRAST * noise_of(window), LEAST_CONTRAST):
        return None, threshold
    rim = np.concatenate([bright[0], bright[-1], bright[1:-1, 0], bright[1:-1, -1]])
    labels, number = scipy.ndimage.label(bright if rim.mean() < 0.5 else ~bright)
    sizes = scipy.ndimage.sum_labels(np.ones_like(window), labels, np.arange(1, number + 1))
    large = np.flatnonzero(sizes >= LEAST_PIXELS) + 1
    rows, columns = np.nonzero(np.isin(labels, large))
    if not len(rows):
        return None, threshold
    nearest = np.argmin((columns - near[0]) ** 2 + (rows - near[1]) ** 2)
    inside = labels == labels[rows[nearest], columns[nearest]]
    return scipy.ndimage.binary_fill_holes(inside), threshold


def _ends_inside(inside) -> bool:
    """Whether the spot, including its blurred edge, is within the window."""
    rows, columns = (np.flatnonzero(inside.any(axis)) for axis in (1, 0))
    free = min(
        rows[0], columns[0], inside.shape[0] - 1 - rows[-1], inside.shape[1] - 1 - columns[-1]
    )
    return free >= MARGIN


def _levels(grey, low, window, inside, threshold) -> Spot:
    """The spot in the smallest window around it, with the levels of target and background."""
    rows, columns = np.nonzero(inside)
    room = 2 * MARGIN
    first = np.maximum([columns.min() - room, rows.min() - room], 0)
    last = np.array([columns.max() + room + 1, rows.max() + room + 1])
    cut = (slice(first[1], last[1]), slice(first[0], last[0]))
    window, inside = window[cut], inside[cut]
    bright = window[inside].mean() > window[~inside].mean()
    core = inside & ~scipy.ndimage.binary_dilation(~inside, iterations=2)
    level = (
        np.median(window[core])
        if core.sum() >= LEAST_PIXELS
        else np.quantile(window[inside], 0.9 if bright else 0.1)
    )
    around = scipy.ndimage.binary_dilation(inside, iterations=MARGIN + 2)
    around &= ~scipy.ndimage.binary_dilation(inside, iterations=MARGIN)
    own = window > threshold if bright else window < threshold
    around &= ~own
    background = np.median(window[around]) if around.any() else np.median(window[~inside])
    return Spot(
        low + first,
        window,
        inside,
        float(background),
        float(level),
        float(background + level) / 2,
        noise_of(window),
    )


def otsu(grey) -> float:
    """The threshold that makes the two classes of grey values differ most (Otsu, 1979)."""
    low, high = float(grey.min()), float(grey.max())
    counts, edges = np.histogram(grey, 256, (low, max(high, low + 1e-9)))
    middle = (edges[:-1] + edges[1:]) / 2
    below, total = np.cumsum(counts), np.cumsum(counts * middle)
    above = below[-1] - below
    with np.errstate(divide="ignore", invalid="ignore"):
        between = below * above * (total / below - (total[-1] - total) / above) ** 2
    best = np.flatnonzero(between >= np.nanmax(between, initial=0.0) * (1 - 1e-12))
    return float(edges[1:][best].mean()) if len(best) else low


def noise_of(grey) -> float:
    """σ of the noise of the grey values (Immerkær, 1996, with the median instead of the mean, since
    edges are outliers); at least that of rounding to whole grey values, 1/√12."""
    if min(grey.shape) < 3:
        return 12**-0.5
    mask = np.array([[1, -2, 1], [-2, 4, -2], [1, -2, 1]])
    response = scipy.ndimage.convolve(grey, mask)[1:-1, 1:-1]
    return max(float(np.median(np.abs(response)) / (6 * 0.6745)), 12**-0.5)
