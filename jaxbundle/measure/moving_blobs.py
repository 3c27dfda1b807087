"""Markers that move before a camera that stands still: light or dark blobs, frame by frame.

    s = ±(g − b)        b: the median over frames of the grey value g of a pixel

Lamps, windows and the room are in b, and vanish; what remains is what moves. A marker is a blob of
s whose outline fills its ellipse of inertia. Its centre is that of its grey values (`targets`):
unlike that of an ellipse it is unbiased, with the stated σ, for blobs that are small, saturated or
blurred by motion.
"""

import dataclasses
from collections.abc import Iterable

import numpy as np
import scipy  # its parts are loaded on use
from jaxtyping import Bool, Float, UInt8

from jaxbundle.errors import InputError
from jaxbundle.measure.spots import MARGIN, SpotSettings
from jaxbundle.measure.targets import Target, centre_by_grey_values
from jaxbundle.network.columns import count

Grey = UInt8[np.ndarray, "rows columns"]


@dataclasses.dataclass(frozen=True)
class BlobSettings:
    """Which blobs are markers.

    **Fields:**

    - `dark`: darker than their surroundings.
    - `min_level`: of the strongest signal in the `sampled` frames, above which a pixel belongs to a
      marker. Distance and motion blur weaken a marker; a person who moves it is weaker still than
      retro reflecting or shining ones. Larger: far markers are lost; smaller: more blobs to tell
      apart.
    - `max_area_misfit`: of the number of pixels of a blob relative to the area of its ellipse of
      inertia. By the raster alone a cross of five pixels has 0.18, a square 0.05.
    - `max_blobs`: in a frame; with more, such as after a lamp was switched, it is not used.
    - `sampled`: frames from which b is computed, at least half of it if the video has that many.
      With few a wand that rests enters b; they are kept in memory together.
    """

    dark: bool = False
    min_level: float = 0.25
    max_area_misfit: float = 0.25
    max_blobs: int = 20
    sampled: int = 30


@dataclasses.dataclass(frozen=True)
class StillScene:
    """What a camera sees without markers, and the signal above which something is one.

    **Fields:** `background` grey values; `level` grey values."""

    background: Grey
    level: float


def find_still_scene(frames: Iterable[Grey], settings: BlobSettings) -> StillScene:
    """The median of frames of one camera.

    **Raises:** `InputError` for fewer than three frames, frames of different sizes, and if nothing
    moves."""
    frames_kept: list[Grey] = []
    stride = number = 0
    for grey in frames:
        if frames_kept and grey.shape != frames_kept[0].shape:
            sizes = (" × ".join(map(str, frame.shape[::-1])) for frame in (grey, frames_kept[0]))
            raise InputError(
                "frame {} has {} pixels, the first {}; expected frames of one size".format(
                    number + 1, *sizes
                )
            )
        if number % (1 << stride) == 0:
            frames_kept.append(grey)
            if len(frames_kept) > settings.sampled:
                # Every second of them, and from here on half as many.
                frames_kept, stride = frames_kept[::2], stride + 1
        number += 1
    if number < 3:
        raise InputError(
            f"{count(number, 'frame')}; expected three or more, with the wand at different places"
        )
    stack = _brighten(np.array(frames_kept), settings)
    # Of an even number the lower of the middle two: a marker in half of the frames is none of it.
    row = (len(stack) - 1) // 2
    background = np.partition(stack, row, axis=0)[row]
    # Signed: darker than the background is less than 0, not 255.
    strongest = max(int((frame.astype(np.int16) - background).max()) for frame in stack)
    min_contrast = SpotSettings().min_contrast
    if strongest < min_contrast:
        raise InputError("nothing moves in the frames; expected a wand that is waved")
    return StillScene(background, max(settings.min_level * strongest, min_contrast))


def find_moving_blobs(grey: Grey, scene: StillScene, settings: BlobSettings) -> list[Target]:
    """The measured centres of the blobs of a frame that are not in the scene and stand free of each
    other; none if there are more than `max_blobs`."""
    signal = _brighten(grey, settings).astype(np.float32) - scene.background
    # Eight neighbours: the pixels of a small blob may touch at their corners only.
    labels, number = scipy.ndimage.label(signal > scene.level, np.ones((3, 3)))
    # So many are noise or another light, and measuring each would take long.
    if number > 10 * settings.max_blobs:
        return []
    targets: list[Target] = []
    for label, window in enumerate(scipy.ndimage.find_objects(labels), 1):
        is_inside = labels[window] == label
        if not _is_ellipse(is_inside, settings.max_area_misfit):
            continue
        # The blurred edge of a neighbour would pull the centre.
        around = labels[tuple(slice(max(s.start - MARGIN, 0), s.stop + MARGIN) for s in window)]
        if np.any((around != 0) & (around != label)):
            continue
        rows, columns = np.nonzero(is_inside)
        approximate = np.array([columns.mean() + window[1].start, rows.mean() + window[0].start])
        try:
            target = centre_by_grey_values(signal, approximate)
        except InputError:
            # Cut by the edge of the image, or within the noise.
            continue
        # A centre outside of the blob is that of something else.
        if target.bright and np.linalg.norm(target.xy - approximate) < max(is_inside.shape):
            targets.append(target)
    return targets if len(targets) <= settings.max_blobs else []


def _brighten(grey: np.ndarray, settings: BlobSettings) -> np.ndarray:
    """Grey values in which markers are light."""
    return 255 - grey if settings.dark else grey


def _is_ellipse(is_inside: Bool[np.ndarray, "rows columns"], tolerance: float) -> bool:
    """Whether the pixels of a blob fill the ellipse of their second moments."""
    xy: Float[np.ndarray, "2 n"] = np.array(np.nonzero(is_inside), float)
    if xy.shape[1] < SpotSettings().min_pixels:
        return False
    from_mean = xy - xy.mean(1, keepdims=True)
    # The area of a pixel has the moment 1/12; an ellipse with the moments C has 4π·√det C.
    C = from_mean @ from_mean.T / xy.shape[1] + np.eye(2) / 12
    return abs(xy.shape[1] / (4 * np.pi * np.sqrt(np.linalg.det(C))) - 1) < tolerance
