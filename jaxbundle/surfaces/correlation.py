"""Normalised cross-correlation along segments, in many images at once.

Both windows are sampled on grids with the epipolar line as first axis. Then all windows along a
segment are parts of one strip, and column k + x of row y is sampled once:

    ρ(k) = Σ t(x, y)·s(k + x, y)/√(Σt²·Σ(s − s̄ₖ)²),    Σt = 0

Positions are one window pixel apart; between them ρ is interpolated by a parabola. Subpixel
positions are left to least squares matching.
"""

import dataclasses
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor

import numpy as np
from jaxtyping import Float, Float32, Shaped

from jaxbundle.photographs.opencv import need_opencv
from jaxbundle.surfaces.segments import Segments, Windows, positions
from jaxbundle.surfaces.views import Grey, OrientedImage, Places
from jaxbundle.system.cores import available_cores

# OpenCV's remap takes images of sides below this.
MAX_REMAP_SIDE = 2**15 - 1
# Standard deviation of a window, relative to the largest grey value, below which it has no texture:
# 0.001 of 255, some thirty roundings of 32 bits. Half and double: no difference.
MIN_CONTRAST = 4e-6


@dataclasses.dataclass(frozen=True)
class Pyramid:
    """An image, and its means over 2 × 2, 4 × 4, … pixels, as float32."""

    levels: tuple[Shaped[np.ndarray, "rows columns"], ...]

    def sample(
        self, level: int, uv: Float[np.ndarray, "rows columns 2"]
    ) -> Float32[np.ndarray, "rows columns"]:
        """Grey values at positions in pixels of the full image; NaN outside."""
        return _interpolate(self.levels[level], (uv + 0.5) / 2**level - 0.5)


def _interpolate(
    grey: Grey, place: Float[np.ndarray, "rows columns 2"]
) -> Float32[np.ndarray, "rows columns"]:
    """Grey values between the pixels of an image; NaN beyond the centres of the outermost."""
    cv2 = need_opencv()
    u, v = place[..., 0], place[..., 1]
    rows, columns = grey.shape
    # (NaN compares as outside)
    all_inside = u.min() >= 0 and u.max() <= columns - 1 and v.min() >= 0 and v.max() <= rows - 1
    is_inside = None if all_inside else (u >= 0) & (u <= columns - 1) & (v >= 0) & (v <= rows - 1)
    places_inside = (u, v) if is_inside is None else (u[is_inside], v[is_inside])
    # Only a part of large images: OpenCV's remap has coordinates of 15 bits.
    (left, right), (top, bottom) = map(_find_extent, places_inside, (columns, rows))
    if max(right - left, bottom - top) >= MAX_REMAP_SIDE:
        # By halves of the rows, or of the columns of a single one: a place alone needs four pixels.
        axis = 0 if len(place) > 1 else 1
        halves = np.array_split(place, 2, axis)
        return np.concatenate([_interpolate(grey, half) for half in halves], axis)
    part = grey[top:bottom, left:right].astype(np.float32)
    u, v = (u - left).astype(np.float32), (v - top).astype(np.float32)
    # Repeated beyond the edge: a place in the last row has four neighbours, two of weight 0.
    values = cv2.remap(part, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return values if is_inside is None else np.where(is_inside, values, np.float32(np.nan))


def make_pyramid(grey: Shaped[np.ndarray, "rows columns"], levels: int) -> Pyramid:
    """The image and the coarser ones."""
    images = [np.asarray(grey)]
    for _ in range(levels):
        images.append(_halve(images[-1]))
    return Pyramid(tuple(images))


def _halve(a: Grey) -> Float32[np.ndarray, "half_rows half_columns"]:
    """Means over 2 × 2 pixels, by strips."""
    rows, columns = (max(n // 2, 1) for n in a.shape)
    out = np.empty((rows, columns), np.float32)
    high, wide = (2 if n > 1 else 1 for n in a.shape)
    # By strips: a whole image of 16 bits would be held as floating point, too.
    strip = 512
    for begin in range(0, rows, strip):
        end = min(begin + strip, rows)
        part = a[high * begin : high * end, : wide * columns].astype(np.float32)
        part = part.reshape(end - begin, high, columns, wide)
        out[begin:end] = part.mean((1, 3))
    return out


def _find_extent(known_places: Float[np.ndarray, "*n"], size: int) -> tuple[int, int]:
    """The first pixel of the part of a row or column around places within it, and the one after its
    last; of no places one pixel."""
    if not known_places.size:
        return 0, 1
    low, high = int(np.floor(known_places.min())) - 1, int(np.ceil(known_places.max())) + 2
    return max(low, 0), min(high, size)


def correlate(
    pair: tuple[OrientedImage, OrientedImage],
    pyramids: tuple[Pyramid, Pyramid],
    uv: Float[np.ndarray, "n 2"],
    segment: Segments,
    window: Windows,
    *,
    level: int,
    half_window: int,
    steps: int,
) -> tuple[Float[np.ndarray, "n steps"], Float[np.ndarray, "n steps"]]:
    """ρ at positions along segments around their middle, and q of the positions.

    **Arguments:** base and other image, and their pyramids; `uv`: points in the base; `level` of
    the pyramids; windows of 2·`half_window` + 1 pixels of it, and `steps` positions with the
    spacing of the window pixels. ρ is NaN outside the other image."""
    scale = 2.0**level
    spacing = scale * np.linalg.norm(window.other_axis, axis=1)
    k = np.arange(steps) - (steps - 1) / 2
    with np.errstate(invalid="ignore", divide="ignore"):
        # In the order of q, though the epipolar axis may be opposite.
        length = segment.length[:, None] / 2 + k * spacing[:, None]
        q = segment.parameter(length)
    place = positions(*pair, uv, q)
    forward = np.sum((place[:, -1] - place[:, 0]) * window.other_axis, axis=1) >= 0
    sign = np.where(forward, 1.0, -1.0)[:, None]

    # The strips of 256 points fit into a processor's cache.
    rows_at_once = 256

    def correlate_rows(begin: int) -> Float[np.ndarray, "m steps"]:
        rows = slice(begin, begin + rows_at_once)
        template = _sample_templates(
            pyramids[0], uv[rows], sign[rows] * window.axis[rows], sign[rows], half_window, level
        )
        strip = _sample_strips(
            pyramids[1],
            place[rows],
            sign[rows] * scale * window.other_axis[rows],
            scale * window.other_cross_axis[rows],
            half_window,
            level,
        )
        return slide(template, strip)

    with ThreadPoolExecutor(available_cores()) as pool:
        parts = list(pool.map(correlate_rows, range(0, len(uv), rows_at_once)))
    rho = np.concatenate(parts) if parts else np.zeros((0, steps), np.float32)
    return np.where(window.usable[:, None], rho, np.nan), q


def slide(
    template: Float[np.ndarray, "n w w"], strip: Float[np.ndarray, "n w columns"]
) -> Float[np.ndarray, "n steps"]:
    """ρ of a window with all windows of a strip; −1 if one has no contrast."""
    n, w, columns = strip.shape
    steps = columns - w + 1
    t = template - template.mean((1, 2), keepdims=True)
    norm = np.sqrt(np.einsum("nyx,nyx->n", t, t))
    is_outside = np.isnan(strip)
    is_lost = _sliding_sum(np.asarray(is_outside.any(1), np.float64), w) > 0
    # Without the mean of the strip: the sums of squares below would lose digits.
    s = np.where(is_outside, 0, strip)
    s -= s.sum((1, 2), keepdims=True) / np.maximum((~is_outside).sum((1, 2), keepdims=True), 1)
    s[is_outside] = 0
    # Pixel of the window by pixel, for all windows and positions at once: windows are not copied,
    # and all arrays stay in the cache.
    cross, product = np.zeros((n, steps), np.float32), np.empty((n, steps), np.float32)
    for y in range(w):
        for x in range(w):
            np.multiply(s[:, y, x : x + steps], t[:, y, x, None], out=product)
            cross += product
    total, square = (_sliding_sum(np.asarray(a.sum(1, dtype=np.float64)), w) for a in (s, s * s))
    norm_of_part = np.sqrt(np.maximum(square - total**2 / w**2, 0))
    largest, of_strip = np.abs(template).max((1, 2)), np.fmax.reduce(np.abs(strip), (1, 2))
    flat = (norm <= MIN_CONTRAST * w * largest)[:, None]
    flat = flat | (norm_of_part <= MIN_CONTRAST * w * of_strip[:, None])
    with np.errstate(invalid="ignore", divide="ignore"):
        rho = np.where(flat, -1.0, cross / (norm[:, None] * norm_of_part))
    return np.where(is_lost | ~np.isfinite(norm)[:, None], np.nan, rho)


def find_peaks(rho: Float[np.ndarray, "n k"]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The largest ρ of each row, its fractional index, and the largest of the others except
    neighbours; NaN if there is none."""
    filled = np.where(np.isfinite(rho), rho, -np.inf)
    best = filled.argmax(1)
    rows, last_column = np.arange(len(rho)), rho.shape[1] - 1
    peak = filled[rows, best]
    left, right = (
        filled[rows, np.maximum(best - 1, 0)],
        filled[rows, np.minimum(best + 1, last_column)],
    )
    with np.errstate(invalid="ignore"):
        bend = left - 2 * peak + right
        inner = (best > 0) & (best < last_column) & np.isfinite(bend) & (bend < 0)
        # The vertex of the parabola through the largest value and its neighbours.
        shift = np.where(inner, 0.5 * (left - right) / np.where(inner, bend, 1.0), 0.0)
    # A peak of correlation is up to two positions wide on each side.
    is_apart = np.abs(np.arange(rho.shape[1]) - best[:, None]) > 2
    second_peak = np.where(is_apart, filled, -np.inf).max(1)
    nan_if_infinite = lambda a: np.where(np.isfinite(a), a, np.nan)
    return (
        nan_if_infinite(peak),
        np.where(np.isfinite(peak), best + shift, np.nan),
        nan_if_infinite(second_peak),
    )


def combine(
    curves: Sequence[Float[np.ndarray, "n k"]],
) -> Float[np.ndarray, "n k"]:
    """ρ of several images at common positions: the mean of the best ⌊n/2⌋ + 1 of n, so that an
    image with a hidden point does not spoil the others; NaN: in no image."""
    if len(curves) == 1:
        return curves[0]
    stacked = np.sort(np.where(np.isfinite(curves), curves, -2.0), axis=0)[::-1]
    has_value = stacked > -2
    number = has_value.sum(0)
    is_used = has_value & (np.arange(len(curves))[:, None, None] < (number + 2) // 2)
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.where(is_used, stacked, 0).sum(0) / is_used.sum(0)


def _sample_templates(
    pyramid: Pyramid,
    uv: Places,
    axis_along: Places,
    sign: Float[np.ndarray, "n 1"],
    half_window: int,
    level: int,
) -> Float32[np.ndarray, "n w w"]:
    """Windows around positions in the base, axes e and e⊥; `sign` −1 if e is reversed."""
    offset = 2.0**level * np.arange(-half_window, half_window + 1)
    axis_across = sign * np.stack([-axis_along[:, 1], axis_along[:, 0]], 1)
    grid = (
        uv[:, None, None]
        + offset[None, None, :, None] * axis_along[:, None, None]
        + offset[None, :, None, None] * axis_across[:, None, None]
    )
    n, w = len(uv), len(offset)
    return pyramid.sample(level, grid.reshape(n * w, w, 2)).reshape(n, w, w)


def _sample_strips(
    pyramid: Pyramid,
    place: Float[np.ndarray, "n steps 2"],
    axis_along: Places,
    axis_across: Places,
    half_window: int,
    level: int,
) -> Float32[np.ndarray, "n w columns"]:
    """All windows along segments: rows across, columns along, half a window more at both ends."""
    n, steps = place.shape[:2]
    steps_beyond = np.arange(1, half_window + 1)
    part_before = place[:, :1] - steps_beyond[::-1, None] * axis_along[:, None]
    part_after = place[:, -1:] + steps_beyond[:, None] * axis_along[:, None]
    middle = np.concatenate([part_before, place, part_after], axis=1)
    grid = (
        middle[:, None]
        + np.arange(-half_window, half_window + 1)[:, None, None] * axis_across[:, None, None]
    )
    w = 2 * half_window + 1
    return pyramid.sample(level, grid.reshape(n * w, -1, 2)).reshape(n, w, -1)


def _sliding_sum(a: Float[np.ndarray, "n columns"], w: int) -> Float[np.ndarray, "n steps"]:
    total = np.cumsum(np.pad(a, ((0, 0), (1, 0))), axis=1)
    return total[:, w:] - total[:, :-w]
