"""Markers of a wand measured in photographs or a video of every camera."""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from jaxbundle.batches.epochs import epoch_keys
from jaxbundle.calibration.rig.wand_markers import Mark, Marks
from jaxbundle.errors import InputError
from jaxbundle.measure.moving_blobs import (
    BlobSettings,
    Grey,
    find_moving_blobs,
    find_still_scene,
)
from jaxbundle.measure.views import name_photographs, photographs
from jaxbundle.network.columns import count
from jaxbundle.network.tables import Camera
from jaxbundle.photographs.formats import is_photograph
from jaxbundle.photographs.reading import read_photograph
from jaxbundle.photographs.video import frames_of_video
from jaxbundle.types import Progress

SEARCHING = "searching the wand"
# Tables, by the end of their names; another file is a photograph or a video.
TABLES = (".csv", ".txt", ".tsv")


def are_images(source: Any) -> bool:
    """Whether what is given of a camera are images, not a table of markers."""
    if isinstance(source, str | Path):
        return Path(source).suffix.lower() not in TABLES
    return isinstance(source, Sequence) and all(isinstance(path, str | Path) for path in source)


def measure_wand(
    sources: Mapping[str, Any],
    cameras: Mapping[str, Camera],
    given_frames: Mapping[str, Sequence[str]],
    settings: BlobSettings,
    progress: Progress | None = None,
) -> tuple[dict[str, Marks], list[str]]:
    """The markers in the images of every camera, without names, and what was not used.

    **Arguments:** `sources`: by camera a folder, photographs, or a video; `given_frames`: frames of
    the cameras whose markers are given, to pair frames by their names.

    **Raises:** `InputError` naming camera and file."""
    frames = {camera: _Frames(images) for camera, images in sources.items()}
    marks_found: dict[str, Marks] = {}
    notes = []
    for camera, frames_of_camera in frames.items():
        try:
            marks, unused = _measure(camera, frames_of_camera, cameras[camera], settings, progress)
        except InputError as error:
            raise InputError(f"camera {camera!r}: {error}") from None
        if not marks:
            kind = "dark" if settings.dark else "bright"
            raise InputError(
                f"camera {camera!r}: no {kind} marker found in "
                f"{count(frames_of_camera.number, 'frame')}"
            )
        marks_found[camera] = marks
        notes += [
            f"camera {camera!r}: {count(unused, 'frame')} without markers, or with more than "
            f"{settings.max_blobs} blobs"
        ] * bool(unused)
    names = {
        camera: tuple(dict.fromkeys(m.frame for m in marks_of_camera))
        for camera, marks_of_camera in marks_found.items()
    }
    keys = epoch_keys(
        names | {name: tuple(frame_names) for name, frame_names in given_frames.items()},
        connected=False,
    )
    by_camera = {
        camera: dict(zip(frame_names, keys[camera])) for camera, frame_names in names.items()
    }
    return {
        camera: [mark._replace(frame=by_camera[camera][mark.frame]) for mark in marks_of_camera]
        for camera, marks_of_camera in marks_found.items()
    }, notes


class _Frames:
    """The frames of a camera: name and grey values; read twice."""

    def __init__(self, source: Any):
        paths = [source] if isinstance(source, str | Path) else list(source)
        single_path = Path(paths[0]) if len(paths) == 1 else None
        self.video = (
            single_path
            if single_path and single_path.is_file() and not is_photograph(single_path)
            else None
        )
        self.files = {} if self.video else name_photographs(photographs(paths))
        self.number = len(self.files)

    def __iter__(self) -> Iterator[tuple[str, Grey]]:
        if self.video is None:
            for name, file in self.files.items():
                yield name, read_photograph(file)
            return
        number = -1
        for number, grey in enumerate(frames_of_video(self.video)):
            yield str(number), grey
        self.number = number + 1


def _measure(
    camera: str,
    frames: _Frames,
    interior: Camera,
    settings: BlobSettings,
    progress: Progress | None,
) -> tuple[Marks, int]:
    """The markers of a camera, and the number of frames without any."""
    scene = find_still_scene((grey for _, grey in frames), settings)
    size = scene.background.shape[::-1]
    if interior.image_size is not None and tuple(interior.image_size) != size:
        raise InputError(
            "the frames have {} × {} pixels, its interior orientation is of {} × {}".format(
                *size, *interior.image_size
            )
        )
    marks, unused = [], 0
    for number_done, (name, grey) in enumerate(frames, 1):
        targets = find_moving_blobs(grey, scene, settings)
        unused += not targets
        marks += [Mark(name, "", *t.xy.tolist(), *t.sigma.tolist()) for t in targets]
        if progress is not None:
            progress(f"{SEARCHING}, camera {camera}", number_done, frames.number)
    return marks, unused


def replaced_sigma(marks: Marks, sigma: float) -> Marks:
    """Markers with a σ that is given instead of the measured one, pixels."""
    return [mark._replace(sx=sigma, sy=sigma) if np.isfinite(mark.sx) else mark for mark in marks]
