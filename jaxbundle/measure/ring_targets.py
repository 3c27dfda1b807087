"""Ring-coded targets: a disc with a ring of sectors about it, and plain discs.

A target is a light disc of radius r on dark ground, and about it a ring from 2·r to 3·r of as many
sectors as bits, light for 1. The code is the smallest number of its bits, clockwise in the
photograph, for any first sector. Its centre is that of the ellipse of the disc (`targets.py`).

Makers print a number beside the target, not the code: the place of the code among all that have
an even number of light sectors and at least one pair of opposite light ones (Schneider, 1999,
patent DE 197 33 466; 147 targets of 12 bits, 516 of 14). A sector read wrongly leaves an odd
number, and is noticed.
"""

import dataclasses
import functools
from collections.abc import Iterator, Sequence

import numpy as np
from jaxtyping import Float, UInt8

from jaxbundle.errors import InputError
from jaxbundle.measure.targets import Target, centre_by_ellipse
from jaxbundle.photographs.opencv import need_opencv

Grey = UInt8[np.ndarray, "rows columns"]


@dataclasses.dataclass(frozen=True)
class RingSettings:
    """Which blobs are taken for discs, and how the ring about one is read.

    **Fields:**

    - `min_pixels`: area within the outline of a disc, pixels: a radius of 3; the sectors of smaller
      ones, of 3 pixels, blur into each other.
    - `max_area_misfit`: of the area of a blob relative to the ellipse through its outline. By the
      raster alone discs are off by up to 0.09 at a radius of 3 and 0.03 at 5. Larger: letters and
      branches are tried as discs, which takes time, and are refused by their ring; half: small
      discs are lost.
    - `level_tolerance`: of the grey value of a sector or of the gap, in contrasts of the disc.
      Above 0.5 a sector is neither light nor dark; the smaller, the more blurred rings are refused.
    - `samples`: in every sector; a fifth at both of its ends is not used.
    """

    min_pixels: int = 20
    max_area_misfit: float = 0.12
    level_tolerance: float = 0.3
    samples: int = 20


@functools.cache
def ring_codes(bits: int) -> tuple[int, ...]:
    """The codes of the printed numbers 1, 2, …: in ascending order."""
    full = 1 << bits
    code = np.arange(1, full - 1)
    smallest, ones, opposite = code.copy(), code & 1, np.zeros(len(code), bool)
    turned = code
    for _ in range(bits - 1):
        turned = (turned >> 1) | (turned & 1) << (bits - 1)
        smallest = np.minimum(smallest, turned)
        ones = ones + (turned & 1)
    half_bits = bits // 2
    opposite = (code & (code >> half_bits)) != 0
    return tuple(code[(code == smallest) & (ones % 2 == 0) & opposite].tolist())


def find_ring_targets(
    grey: Grey, bits: int, settings: RingSettings, numbered: bool = True
) -> list[tuple[str, Target]]:
    """Ring-coded targets, light on dark.

    **Arguments:** `numbered`: named by the printed number, without codes that have none; otherwise
    by the code."""
    number = {c: k for k, c in enumerate(ring_codes(bits), 1)} if numbered else None
    readings: list[tuple[float, str, Target]] = []
    for target in find_discs(grey, settings):
        reading = _read_code(grey, target, bits, settings)
        if reading is None:
            continue
        misfit, code = reading
        if number is None:
            readings.append((misfit, str(code), target))
        elif code in number:
            readings.append((misfit, str(number[code]), target))
    distinct: list[tuple[str, Target]] = []
    for _, name, target in sorted(readings, key=lambda reading: reading[0]):
        # A sector of a ring may look like a disc with a ring; the more distinct one is right.
        ring = 3 * target.axes[0]
        if all(np.linalg.norm(target.xy - t.xy) > max(ring, 3 * t.axes[0]) for _, t in distinct):
            distinct.append((name, target))
    return distinct


def find_plain_discs(grey: Grey, coded: Sequence[Target], settings: RingSettings) -> list[Target]:
    """Light discs that are neither coded targets nor sectors of their rings."""
    plain: list[Target] = []
    for disc in find_discs(grey, settings):
        # The outermost parts of a ring are 3 radii from the centre. Both outlines of the light
        # ground about a dark patch lead to the disc in its middle again.
        others = [(t.xy, 3.5 * t.axes[0]) for t in coded] + [(t.xy, t.axes.min()) for t in plain]
        if all(np.linalg.norm(disc.xy - xy) > nearest for xy, nearest in others):
            plain.append(disc)
    return plain


def find_discs(grey: Grey, settings: RingSettings) -> Iterator[Target]:
    """Light discs, each measured."""
    for approximate in _blobs(grey, settings):
        try:
            target = centre_by_ellipse(grey, approximate)
        except InputError:
            continue
        if target.bright:
            yield target


def _blobs(grey: Grey, settings: RingSettings) -> Iterator[Float[np.ndarray, "2"]]:
    """Centres of light blobs that fill the ellipse of their outline."""
    cv2 = need_opencv()
    # A local threshold follows uneven light; 8 grey values above the mean of a window of a
    # twentieth of the image: noise of σ 2 exceeds it once in 30 000 pixels.
    side = max(15, (min(grey.shape) // 20) | 1)
    light = cv2.adaptiveThreshold(
        grey, 255, cv2.ADAPTIVE_THRESH_MEAN_C, cv2.THRESH_BINARY, side, -8
    )
    outlines, _ = cv2.findContours(light, cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
    for outline in outlines:
        area = cv2.contourArea(outline)
        if area < settings.min_pixels or len(outline) < 6:  # fitEllipse needs five points
            continue
        middle, axes, _ = cv2.fitEllipse(outline)
        # The outline passes through the centres of the outermost pixels.
        full = np.pi / 4 * axes[0] * axes[1]
        # A ratio of axes of 0.25: a target seen 75° from its normal.
        misfit = abs(area / max(full, 1e-9) - 1)
        if min(axes) > 0.25 * max(axes) and misfit < settings.max_area_misfit:
            yield np.array(middle)


def _read_code(
    grey: Grey, target: Target, bits: int, settings: RingSettings
) -> tuple[float, int] | None:
    """The misfit of the ring around a disc, and its code; None if there is none."""
    from scipy.ndimage import map_coordinates

    samples, tolerance = settings.samples, settings.level_tolerance
    n = bits * samples
    t = 2 * np.pi * np.arange(n) / n
    c, s = np.cos(target.angle), np.sin(target.angle)
    turn = np.array([[c, -s], [s, c]])
    rim = target.axes * np.stack([np.cos(t), np.sin(t)], 1) @ turn.T
    # In the middle of the gap (r to 2·r) and of the ring (2·r to 3·r), and beyond it, still on
    # the dark ground.
    places = target.xy + np.array([1.5, 2.5, 3.4])[:, None, None] * rim
    u, v = places[..., 0], places[..., 1]
    is_inside = (u >= 0) & (v >= 0) & (u <= grey.shape[1] - 1) & (v <= grey.shape[0] - 1)
    # A ring at the edge of the photograph is whole; the ground beyond it need not be.
    if not is_inside[:2].all():
        return None
    gap, ring, beyond = map_coordinates(grey.astype(float), [v, u], order=1)
    dark = np.median(gap)
    gap, value, beyond = ((a - dark) / target.contrast for a in (gap, ring, beyond[is_inside[2]]))
    if np.abs(gap).max() > tolerance or beyond.mean() > 0.5:
        return None
    # The sectors begin where the values within them vary least; their blurred ends do not count.
    by_start = np.stack([np.roll(value, -k).reshape(bits, samples) for k in range(samples)])
    inner = by_start[:, :, samples // 5 : -(samples // 5)]
    best = int(inner.var(2).sum(1).argmin())
    means = inner[best].mean(1)
    deviation = np.minimum(np.abs(means), np.abs(means - 1))
    if np.any(deviation > tolerance):
        return None
    word = (means > 0.5).astype(int)
    if not word.any() or word.all():
        return None
    weights = 1 << np.arange(bits - 1, -1, -1)
    misfit = float(deviation.mean() + np.abs(gap).mean())
    return misfit, min(int(np.roll(word, -k) @ weights) for k in range(bits))
