"""`frames`: photographs out of videos."""

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from jaxbundle.arguments import integer
from jaxbundle.display import print_in_one_screen
from jaxbundle.errors import InputError
from jaxbundle.io.writing.folders import replace_folder
from jaxbundle.network.columns import count
from jaxbundle.photographs.video import (
    FrameSettings,
    VideoLook,
    choose_frames,
    file_of_frame,
    look_at_video,
    write_frames,
)
from jaxbundle.results import TableMethods
from jaxbundle.types import Progress

BY = "frames"
TABLE = "frames.csv"


@print_in_one_screen
@dataclasses.dataclass(frozen=True)
class VideoFrames(TableMethods):
    """Frames chosen from videos: their `number` in each [videos, n], the time in seconds, the
    sharpness, the `folders` into which they were written, and the names of the files there
    (`image`)."""

    videos: tuple[Path, ...]
    folders: tuple[Path, ...]
    frames_of_videos: tuple[int, ...]
    number: Int[np.ndarray, "videos n"]
    time: Float[np.ndarray, "videos n"]
    sharpness: Float[np.ndarray, "videos n"]
    image: tuple[str, ...]

    def table(self) -> dict[str, np.ndarray]:
        """A row for each frame of each video."""
        names = np.array([f.name for f in self.folders], dtype=object)
        return {
            "video": np.repeat(names, self.number.shape[1]),
            "frame": self.number.ravel(),
            "image": np.tile(np.array(self.image, dtype=object), len(self.videos)),
            "time": self.time.ravel(),
            "sharpness": self.sharpness.ravel(),
        }

    def to_dict(self) -> dict[str, Any]:
        """Videos, folders and frames as plain dicts and lists."""
        return {
            "videos": [
                {
                    "file": str(video),
                    "folder": str(folder),
                    "frames": frames,
                    "number": number.tolist(),
                    "time": time.tolist(),
                    "sharpness": sharpness.tolist(),
                }
                for video, folder, frames, number, time, sharpness in zip(
                    self.videos,
                    self.folders,
                    self.frames_of_videos,
                    self.number,
                    self.time,
                    self.sharpness,
                )
            ]
        }

    def __str__(self) -> str:
        lines = [
            f"{video}: {count(len(number), 'frame')} of {frames} in {folder}"
            for video, folder, frames, number in zip(
                self.videos, self.folders, self.frames_of_videos, self.number
            )
        ]
        return "\n".join(lines)


def frames(
    videos: str | Path | Sequence[str | Path],
    out: str | Path,
    *,
    number: int = 60,
    every: int | None = None,
    first: Sequence[int] = (),
    force: bool = False,
    settings: FrameSettings | None = None,
    progress: Progress = lambda *_: None,
) -> VideoFrames:
    """Choose sharp frames that differ from videos and write them as photographs.

    Frames of several videos are of the same instants, and have the same last number in their names:
    `calibrate_rig` takes them as simultaneous.

    **Arguments:**

    - `videos`: files. Several: of cameras that run at one rate.
    - `out`: folder; in it a folder for each video, of its name, and a table `frames.csv`.
    - `number`: of frames at most, fewer if the pictures do not differ.
    - `every`: instead, every `every`-th frame, sharp or not, of videos that need not be
      simultaneous or run at one rate: to find offsets of time (`calibrate_rig(…, synchronize=…)`).
    - `first`: for each video the frame at which all begin, if they were not started together.
    - `force`: replace a folder of other content.
    - `settings`: see `FrameSettings`; `number` replaces that of them.
    - `progress(stage, done, total)`.

    **Raises:** `InputError`.
    """
    paths = [Path(v) for v in ([videos] if isinstance(videos, str | Path) else videos)]
    settings = dataclasses.replace(settings or FrameSettings(), number=number)
    names = _names(paths)
    begin = list(first) or [0] * len(paths)
    if len(begin) != len(paths) or min(begin) < 0:
        raise InputError(
            f"first: expected {count(len(paths), 'frame number')} of 0 or more, got {begin}"
        )
    with replace_folder(out, BY, (*names, TABLE), force) as new:
        looks = [look_at_video(path, settings, progress) for path in paths]
        if every is None:
            _check_together(looks, begin)
            frame_numbers = choose_frames(looks, begin, settings)
        else:
            length = min(len(look) - skipped for look, skipped in zip(looks, begin))
            frame_numbers = np.arange(0, length, integer("every", every, least=1))
        for path, name, skipped in zip(paths, names, begin):
            # Equal numbers in the names are one instant.
            write_frames(path, frame_numbers + skipped, skipped, new / name)
            progress(f"writing {name}", 1, 1)
        numbers = np.stack([frame_numbers + skipped for skipped in begin])
        result = VideoFrames(
            tuple(paths),
            tuple(Path(out) / name for name in names),
            tuple(map(len, looks)),
            numbers,
            np.stack([n / look.rate for n, look in zip(numbers, looks)]),
            np.stack([look.sharpness[n] for n, look in zip(numbers, looks)]),
            tuple(file_of_frame(k) for k in frame_numbers.tolist()),
        )
        table = result.table()
        rows = zip(*(column.tolist() for column in table.values()))
        text = "".join(f"{v},{f},{i},{t:.9f},{s:.6g}\n" for v, f, i, t, s in rows)
        (new / TABLE).write_text(f"{','.join(table)}\n{text}", encoding="utf-8")
    return result


def _names(paths: Sequence[Path]) -> list[str]:
    """Names of the folders: those of the files, with their folder if two are the same."""
    if not paths:
        raise InputError("videos: expected one or more files, got none")
    stems = [path.stem for path in paths]
    names = [
        f"{path.resolve().parent.name}_{stem}" if stems.count(stem) > 1 else stem
        for path, stem in zip(paths, stems)
    ]
    twice = [path for path, name in zip(paths, names) if names.count(name) > 1]
    if twice:
        raise InputError(f"{twice[0]}: given twice, or two videos of one name and folder")
    return names


def _check_together(looks: Sequence[VideoLook], first: Sequence[int]) -> None:
    """Refuse videos whose frames of one number are not simultaneous."""
    for look, begin in zip(looks, first):
        if begin >= len(look):
            raise InputError(
                f"{look.path}: has {count(len(look), 'frame')}, the first one is given as {begin}"
            )
    length = min(len(look) - begin for look, begin in zip(looks, first))
    for look in looks[1:]:
        # After the whole video they may differ by half a frame.
        if abs(look.rate / looks[0].rate - 1) * length > 0.5:
            raise InputError(
                f"{look.path}: {look.rate:g} frames a second, but {looks[0].path} has "
                f"{looks[0].rate:g}: frames of one number are not simultaneous; convert one of them"
            )
