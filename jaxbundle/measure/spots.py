"""A light or dark spot in a photograph: its window, its threshold, its pixels.

A window around the given position grows until it contains the nearest spot. Threshold within a
window: the grey value that separates two classes best (Otsu, 1979); the rim of the window
is background. The noise σg of the grey values is estimated by a mask that cancels
linear changes of the image (Immerkær, 1996).
"""

import dataclasses

import numpy as np
import scipy  # its parts are loaded on use
from jaxtyping import Bool, Float, Int, Real

from jaxbundle.display import print_in_one_screen
from jaxbundle.errors import InputError

Window = Float[np.ndarray, "rows columns"]
Mask = Bool[np.ndarray, "rows columns"]

# Pixels of the blurred edge beyond the spot: that of a lens a little out of focus, τ = 1 pixel, to
# 3·τ. A spot whose margin is cut is not measured.
MARGIN = 3


@dataclasses.dataclass(frozen=True)
class SpotSettings:
    """What counts as a spot.

    **Fields:**

    - `first_half_window`, `last_half_window`: half of the side of the window about the given
      position, pixels, doubled from the first to the last. The first: a position within a few
      pixels, and small targets are found without a neighbour in the window; the last bounds the
      time, and the size of a target to 500 pixels.
    - `min_contrast_sigma`: difference of spot and background in σ of the noise. Otsu's threshold
      always finds two classes: in noise alone, about 1.6 σ apart.
    - `min_contrast`: the same in grey values, for images without noise (rendered, or smoothed by
      compression), in which steps of one or two grey values remain; not critical.
    - `min_pixels`: of a spot; with fewer there is no shape.
    """

    first_half_window: int = 8
    last_half_window: int = 256
    min_contrast_sigma: float = 5.0
    min_contrast: float = 4.0
    min_pixels: int = 5


@print_in_one_screen
@dataclasses.dataclass(frozen=True)
class Spot:
    """A spot in its window: the window's corner (column, row) in the photograph, grey values, the
    pixels of the spot, and the levels."""

    corner: Int[np.ndarray, "2"]
    grey: Window
    inside: Mask
    background: float
    level: float
    threshold: float
    noise: float

    @property
    def contrast(self) -> float:
        return self.level - self.background


def find_spot(
    grey: Window, approximate: Float[np.ndarray, "2"], settings: SpotSettings | None = None
) -> Spot:
    """The spot nearest to `approximate` (column, row) in `grey` [rows, columns].

    **Raises:** `InputError` if none stands out, or it is cut by the edge of the image.
    """
    settings = settings or SpotSettings()
    where = f"at ({approximate[0]:.1f}, {approximate[1]:.1f})"
    rows, columns = grey.shape
    if not (0 <= approximate[0] < columns and 0 <= approximate[1] < rows):
        raise InputError(f"{where}: outside the image of {columns} × {rows} pixels")
    why = "no target stands out from its surroundings"
    half_window = settings.first_half_window
    while half_window <= settings.last_half_window:
        low = np.maximum(np.rint(approximate).astype(int) - half_window, 0)
        high = np.minimum(np.rint(approximate).astype(int) + half_window + 1, [columns, rows])
        window = grey[low[1] : high[1], low[0] : high[0]]
        is_inside, threshold = _nearest_spot(window, approximate - low, settings)
        if is_inside is not None:
            if _ends_inside(is_inside):
                return _levels(low, window, is_inside, threshold, settings)
            why = "the target reaches the edge of the image, or joins its surroundings"
        if (low == 0).all() and (high == [columns, rows]).all():
            break
        half_window *= 2
    raise InputError(f"{where}: {why}")


def _nearest_spot(
    window: Window, approximate: Float[np.ndarray, "2"], settings: SpotSettings
) -> tuple[Mask | None, float]:
    """Pixels of the spot nearest to a position, and the threshold; None if there is none."""
    threshold = otsu(window)
    bright = window > threshold
    contrast = window[bright].mean() - window[~bright].mean() if bright.any() else 0.0
    if contrast < max(settings.min_contrast_sigma * noise_of(window), settings.min_contrast):
        return None, threshold
    # Most of the rim of the window is background.
    rim = np.concatenate([bright[0], bright[-1], bright[1:-1, 0], bright[1:-1, -1]])
    labels, number = scipy.ndimage.label(bright if rim.mean() < 0.5 else ~bright)
    sizes = scipy.ndimage.sum_labels(np.ones_like(window), labels, np.arange(1, number + 1))
    large = np.flatnonzero(sizes >= settings.min_pixels) + 1
    rows, columns = np.nonzero(np.isin(labels, large))
    if not len(rows):
        return None, threshold
    nearest = np.argmin((columns - approximate[0]) ** 2 + (rows - approximate[1]) ** 2)
    is_inside = labels == labels[rows[nearest], columns[nearest]]
    return scipy.ndimage.binary_fill_holes(is_inside), threshold


def _ends_inside(is_inside: Mask) -> bool:
    """Whether the spot, including its blurred edge, is within the window."""
    rows, columns = (np.flatnonzero(is_inside.any(axis)) for axis in (1, 0))
    free = min(
        rows[0], columns[0], is_inside.shape[0] - 1 - rows[-1], is_inside.shape[1] - 1 - columns[-1]
    )
    return free >= MARGIN


def _levels(
    low: Int[np.ndarray, "2"],
    window: Window,
    is_inside: Mask,
    threshold: float,
    settings: SpotSettings,
) -> Spot:
    """The spot in the smallest window around it, with the levels of target and background."""
    rows, columns = np.nonzero(is_inside)
    room = 2 * MARGIN
    first_corner = np.maximum([columns.min() - room, rows.min() - room], 0)
    last_corner = np.array([columns.max() + room + 1, rows.max() + room + 1])
    window_of_spot = (
        slice(first_corner[1], last_corner[1]),
        slice(first_corner[0], last_corner[0]),
    )
    window, is_inside = window[window_of_spot], is_inside[window_of_spot]
    is_bright = window[is_inside].mean() > window[~is_inside].mean()
    # The level of the target two pixels within it, where the blurred edge ends; a spot that small
    # is nowhere at its level, which is then between its middle and its extreme.
    core = is_inside & ~scipy.ndimage.binary_dilation(~is_inside, iterations=2)
    level = (
        np.median(window[core])
        if core.sum() >= settings.min_pixels
        else np.quantile(window[is_inside], 0.9 if is_bright else 0.1)
    )
    # The background from a ring of two pixels beyond the blurred edge, without neighbours.
    around = scipy.ndimage.binary_dilation(is_inside, iterations=MARGIN + 2)
    around &= ~scipy.ndimage.binary_dilation(is_inside, iterations=MARGIN)
    around &= ~(window > threshold if is_bright else window < threshold)
    background = np.median(window[around]) if around.any() else np.median(window[~is_inside])
    return Spot(
        low + first_corner,
        window,
        is_inside,
        float(background),
        float(level),
        float(background + level) / 2,
        noise_of(window),
    )


def otsu(grey: Real[np.ndarray, "rows columns"]) -> float:
    """The threshold that makes the two classes of grey values differ most (Otsu, 1979)."""
    low, high = float(grey.min()), float(grey.max())
    counts, edges = np.histogram(grey, 256, (low, max(high, low + 1e-9)))
    middle = (edges[:-1] + edges[1:]) / 2
    number_below, total = np.cumsum(counts), np.cumsum(counts * middle)
    number_above = number_below[-1] - number_below
    with np.errstate(divide="ignore", invalid="ignore"):
        variance_between = (
            number_below
            * number_above
            * (total / number_below - (total[-1] - total) / number_above) ** 2
        )
    # Between two peaks all empty bins are equally good: their middle.
    best = np.flatnonzero(
        variance_between >= np.nanmax(variance_between, initial=0.0) * (1 - 1e-12)
    )
    return float(edges[1:][best].mean()) if len(best) else low


def noise_of(grey: Real[np.ndarray, "rows columns"]) -> float:
    """σ of the noise of the grey values (Immerkær, 1996, with the median instead of the mean, since
    edges are outliers); at least that of rounding to whole grey values, 1/√12."""
    if min(grey.shape) < 3:
        return 12**-0.5
    # Laplacian of the Laplacian: 0 for linear and quadratic changes; its σ in noise of σ 1 is
    # √36 = 6, and 0.6745 the median of |x| of a normal x
    mask = np.array([[1, -2, 1], [-2, 4, -2], [1, -2, 1]])
    response = scipy.ndimage.convolve(np.asarray(grey, float), mask)[1:-1, 1:-1]
    return max(float(np.median(np.abs(response)) / (6 * 0.6745)), 12**-0.5)
