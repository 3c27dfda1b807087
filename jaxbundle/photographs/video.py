"""Photographs out of videos: sharp frames that differ, of several cameras at the same instants.

Every frame is looked at, reduced to a few hundred pixels. Of the sharp ones those are chosen that
differ most from all chosen before (farthest-first, Gonzalez 1985, Clustering to minimize the
maximum intercluster distance): a board that is held still gives one frame, not a hundred.
"""

import dataclasses
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from jaxbundle.arguments import integer
from jaxbundle.errors import InputError
from jaxbundle.photographs.opencv import need_opencv
from jaxbundle.types import Progress


@dataclasses.dataclass(frozen=True)
class FrameSettings:
    """Which frames of a video are chosen.

    **Fields:**

    - `number`: of frames, at most.
    - `min_sharpness`: relative to the sharpest frame within half a `window` (seconds). Motion
      by 3, 5, 9, 15 pixels of 1280 leaves 0.76, 0.56, 0.36, 0.25 of it (photographs of `rig4`).
    - `min_overall`: relative to the median of these sharpest frames: a longer motion is left out.
      Smaller: blurred frames of it are chosen; larger: whole views of little texture are not.
    - `min_change`: RMS difference of two frames whose grey values have a σ of 1. A shift by a tenth
      of the size of what is seen gives 0.1; 1.4 are two pictures that have nothing in common.
    - `side`: pixels of the longer side to which a frame is reduced to measure its sharpness; motion
      of a few pixels of a large frame is still seen.
    - `thumbnail`: pixels of the longer side to which it is reduced to compare it with others.
    """

    number: int = 60
    window: float = 1.0
    min_sharpness: float = 0.8
    min_overall: float = 0.4
    min_change: float = 0.1
    side: int = 640
    thumbnail: int = 32

    def __post_init__(self):
        integer("number", self.number, least=1)


@dataclasses.dataclass(frozen=True)
class VideoLook:
    """What was seen of a video: frames a second; `sharpness` of every frame, the variance of the
    second differences of its grey values relative to the square of their mean; its `thumbnail`."""

    path: Path
    rate: float
    sharpness: Float[np.ndarray, " frames"]
    thumbnail: Float[np.ndarray, "frames pixels"]

    def __len__(self) -> int:
        return len(self.sharpness)


def look_at_video(path: Path, settings: FrameSettings, progress: Progress) -> VideoLook:
    """Sharpness and thumbnails of all frames.

    **Raises:** `InputError` if it is not a video."""
    cv2 = need_opencv()
    sharpness, thumbnails = [], []
    with _open_video(path) as video:
        rate = float(video.get(cv2.CAP_PROP_FPS))
        frame_count = max(int(video.get(cv2.CAP_PROP_FRAME_COUNT)), 1)
        for grey in _grey_frames(video):
            small = _reduce(grey, settings.side).astype(np.float32)
            # Of the same view at another exposure it is the same; blur does not change the mean.
            sharpness.append(cv2.Laplacian(small, cv2.CV_32F).var() / max(small.mean(), 1.0) ** 2)
            tiny = _reduce(small, settings.thumbnail).ravel()
            # Of less contrast than a grey value noise would count as change.
            thumbnails.append((tiny - tiny.mean()) / max(float(tiny.std()), 1.0))
            if len(sharpness) % 32 == 0:
                progress(f"frames of {path.name}", min(len(sharpness), frame_count), frame_count)
    if not sharpness:
        raise InputError(f"{path}: a video without frames")
    # Some containers state no rate.
    rate = rate if np.isfinite(rate) and rate > 0 else 30.0
    return VideoLook(path, rate, np.array(sharpness), np.array(thumbnails))


def choose_frames(
    videos: Sequence[VideoLook], first_frames: Sequence[int], settings: FrameSettings
) -> Int[np.ndarray, " n"]:
    """Instants at which the frames of all videos are sharp and differ, in order: frame numbers
    after the first frame of each, `first_frames`.

    **Raises:** `InputError` if there is none."""
    length = min(len(v) - f for v, f in zip(videos, first_frames))
    # Blurred in one video is of no use in the others.
    sharp = np.ones(length, bool)
    for video, first_frame in zip(videos, first_frames):
        sharpness = video.sharpness[first_frame : first_frame + length]
        sharp &= _is_sharp(sharpness, video.rate, settings)
    candidates = np.flatnonzero(sharp)
    if not len(candidates):
        raise InputError(
            f"{', '.join(str(v.path) for v in videos)}: no instant at which all are sharp"
        )
    pictures = [v.thumbnail[f : f + length][candidates] for v, f in zip(videos, first_frames)]
    change = np.full(len(candidates), np.inf)
    chosen_candidates: list[int] = []
    # Begins with the sharpest, relative to the brightness of its own video.
    best = int(
        np.argmax(videos[0].sharpness[first_frames[0] : first_frames[0] + length][candidates])
    )
    while len(chosen_candidates) < settings.number and change[best] >= settings.min_change:
        chosen_candidates.append(best)
        # New in one video is new.
        difference = [np.sqrt(((p - p[best]) ** 2).mean(1)) for p in pictures]
        change = np.minimum(change, np.max(difference, axis=0))
        best = int(np.argmax(change))
    return np.sort(candidates[chosen_candidates])


def frames_of_video(path: Path) -> Iterator[UInt8[np.ndarray, "rows columns"]]:
    """The grey values of all frames of a video.

    **Raises:** `InputError` if it is not a video, or has no frames."""
    empty = True
    with _open_video(path) as video:
        for grey in _grey_frames(video):
            empty = False
            yield grey
    if empty:
        raise InputError(f"{path}: a video without frames")


def file_of_frame(number: int) -> str:
    """The name of the file of a frame."""
    return f"frame_{number:06d}.png"


def write_frames(
    path: Path, numbers: Int[np.ndarray, " n"], first_frame: int, folder: Path
) -> None:
    """Write frames as `frame_000123.png`, counted from `first_frame`, without loss.

    **Raises:** `InputError` if the video ends before."""
    cv2 = need_opencv()
    frame_numbers, written_count = set(numbers.tolist()), 0
    folder.mkdir()
    with _open_video(path) as video:
        # One by one: to jump to a frame is inexact with most codecs.
        for number in range(int(numbers.max(initial=-1)) + 1):
            if not video.grab():
                break
            if number in frame_numbers:
                is_read, frame = video.retrieve()
                file = folder / file_of_frame(number - first_frame)
                if not is_read:
                    break
                content = cv2.imencode(".png", frame)[1]
                file.write_bytes(content.tobytes())
                written_count += 1
    if written_count < len(frame_numbers):
        raise InputError(f"{path}: ends before frame {numbers.max()}, which was there before")


@contextmanager
def _open_video(path: Path) -> Iterator[Any]:
    cv2 = need_opencv()
    if not path.is_file():
        raise InputError(f"{path}: no such file")
    video = cv2.VideoCapture(str(path))
    try:
        if not video.isOpened():
            raise InputError(f"{path}: not a video that OpenCV can read")
        yield video
    finally:
        video.release()


def _grey_frames(video: Any) -> Iterator[UInt8[np.ndarray, "rows columns"]]:
    cv2 = need_opencv()
    while True:
        is_read, frame = video.read()
        if not is_read:
            return
        yield cv2.cvtColor(frame, cv2.COLOR_BGR2GRAY) if frame.ndim == 3 else frame


def _reduce(grey: np.ndarray, side: int) -> np.ndarray:
    cv2 = need_opencv()
    rows, columns = grey.shape
    factor = min(side / max(rows, columns), 1.0)
    size = max(round(columns * factor), 1), max(round(rows * factor), 1)
    return cv2.resize(grey, size, interpolation=cv2.INTER_AREA)


def _is_sharp(
    sharpness: Float[np.ndarray, " n"], rate: float, settings: FrameSettings
) -> Bool[np.ndarray, " n"]:
    from scipy.ndimage import maximum_filter1d

    size = 2 * max(round(settings.window * rate / 2), 1) + 1
    sharpest = maximum_filter1d(sharpness, size, mode="nearest")
    typical_sharpness = np.median(sharpest)
    local = sharpness >= settings.min_sharpness * sharpest
    return np.asarray(local & (sharpness >= settings.min_overall * typical_sharpness))
