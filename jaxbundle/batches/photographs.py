"""Cameras of a batch from folders of photographs of a board, one folder a camera.

The board is searched in separate processes, one photograph at a time: an image that crashes OpenCV
affects only itself. Results are kept (`io.boards.kept_corners`), so that no photograph is searched
twice. Cameras of one image size are then calibrated together (`calibrate_batch`).
"""

import dataclasses
import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from jaxbundle.batches.calibrate import calibrate_batch
from jaxbundle.batches.input import pixel_model
from jaxbundle.batches.result import BatchCalibration
from jaxbundle.cameras.pixel_frame import in_model_units
from jaxbundle.errors import InputError
from jaxbundle.io.boards.kept_corners import KeptCorners
from jaxbundle.io.formats import recognise_format
from jaxbundle.io.writing.fingerprints import of_words
from jaxbundle.measure.boards import Board
from jaxbundle.measure.views import (
    BoardViews,
    Look,
    collect_views,
    name_photographs,
    photographs,
)
from jaxbundle.network.columns import list_some
from jaxbundle.photographs.formats import SUFFIXES
from jaxbundle.system.workers import Failed, Workers


class NotSearched(str):
    """Why a photograph could not be searched: the machine lacked memory, or the search crashed."""


# The entry of a line: names of photographs that the result lacks by a fault of the machine.
NOT_SEARCHED = "photographs_not_searched"


def is_photograph_folder(path: str | Path) -> bool:
    """Whether an input is a folder, and none that holds a network."""
    return os.path.isdir(path) and recognise_format(Path(path)) is None


def has_photographs(path: str | Path) -> bool:
    """Whether a folder holds photographs itself."""
    try:
        return any(file.suffix.lower() in SUFFIXES for file in Path(path).iterdir())
    except OSError:
        return False


def camera_folders(path: str | Path) -> list[Path]:
    """The folders of photographs in a folder, by name."""
    try:
        return sorted(
            entry for entry in Path(path).iterdir() if entry.is_dir() and has_photographs(entry)
        )
    except OSError:
        return []


@dataclasses.dataclass(frozen=True)
class PhotographFolders:
    """Folders of photographs of one board, what was found in them, and who searches."""

    folders: Sequence[str]
    board: Board
    kept_corners: KeptCorners
    workers: Workers

    def fingerprint(self, folder: int) -> str:
        """The fingerprint of the content of the photographs of a folder."""
        files = self._files(folder)
        return of_words(f"{name} {self.kept_corners.content(path)}" for name, path in files.items())

    def measure(
        self, folders: Sequence[int], tell: Callable[[float], None] = lambda _: None
    ) -> dict[int, BoardViews | str]:
        """The views of some of the folders, or why there are none.

        `tell(part)`: the fraction of the photographs searched."""
        files = {folder: self._files(folder) for folder in folders}
        # By content, not by name: a photograph copied to two folders is searched once.
        contents = {
            path: self.kept_corners.content(path)
            for files_of_folder in files.values()
            for path in files_of_folder.values()
        }
        tasks = {
            content: (path, self.board)
            for path, content in contents.items()
            if content and self.kept_corners.look(content, self.board) is None
        }
        not_searched: dict[str, NotSearched] = {}
        for number_done, (task, look) in enumerate(self.workers.run(tasks.values()), 1):
            content = contents[task[0]]
            if isinstance(look, Failed):
                # Not kept: another run may have more memory.
                not_searched[content] = NotSearched(look.why)
            else:
                self.kept_corners.keep(content, self.board, look)
            tell(number_done / len(tasks))
        return {
            folder: self._views(folder, files[folder], contents, not_searched) for folder in folders
        }

    def _views(
        self,
        folder: int,
        files: Mapping[str, Path],
        contents: Mapping[Path, str],
        not_searched: Mapping[str, NotSearched],
    ) -> BoardViews | str:
        if not files:
            return _why_empty(self.folders[folder])
        looks: dict[str, Look] = {}
        first_of_content: dict[str, str] = {}
        for name, path in files.items():
            content = contents[path]
            looks[name] = (
                "cannot be read"
                if not content
                else f"is the same file as {first_of_content[content]}"
                if content in first_of_content
                else not_searched.get(content)
                or self.kept_corners.look(content, self.board)
                or "was not searched"
            )
            first_of_content.setdefault(content, name)
        try:
            return collect_views(
                files, looks, self.board, hints=not {*not_searched} & {*first_of_content}
            )
        except InputError as error:
            return str(error)

    def _files(self, folder: int) -> dict[str, Path]:
        try:
            return name_photographs(photographs([self.folders[folder]]))
        except (InputError, OSError):
            return {}


def _why_empty(folder: str | Path) -> str:
    folders_inside = [entry.name for entry in camera_folders(folder)]
    if not folders_inside:
        return "no photographs in this folder"
    return (
        f"no photographs in this folder, but in {list_some(folders_inside, 3, str)} in it: give "
        "--rig for cameras on one mounting, or these folders"
    )


def calibrate_views(
    views: Mapping[int, BoardViews], options: Mapping[str, Any]
) -> Iterable[tuple[int, BatchCalibration, int]]:
    """Calibrate cameras from views of a board, those of one image size together: of each camera its
    number, the batch it was calibrated in, and its place there; `options` of `calibrate_batch`."""
    model = pixel_model(options["model"])
    for size in dict.fromkeys(views_of_camera.image_size for views_of_camera in views.values()):
        numbers = [
            number
            for number, views_of_camera in views.items()
            if views_of_camera.image_size == size
        ]
        max_views = max(len(views[number]) for number in numbers)
        board = views[numbers[0]].board
        xy = np.full((len(numbers), max_views, len(board.ids), 2), np.nan)
        for place, number in enumerate(numbers):
            xy[place, : len(views[number])] = in_model_units(views[number].xy, model, size)
        batch = calibrate_batch(board.points, xy, size, visible=~np.isnan(xy[..., 0]), **options)
        yield from ((number, batch, place) for place, number in enumerate(numbers))


def of_photographs(views: BoardViews, brief: bool) -> dict:
    """The entries of a line about the photographs of a camera."""
    row: dict[str, Any] = {"image_size": list(views.image_size)}
    if not brief:
        row["photographs"] = list(views.names)
    return row | of_unused(dict(views.failed))


def of_unused(unused: Mapping[str, str]) -> dict[str, Any]:
    """The entries of a line about photographs that were not used, with the reasons."""
    unsearched = [name for name, why in unused.items() if isinstance(why, NotSearched)]
    return ({"photographs_not_used": dict(unused)} if unused else {}) | (
        {NOT_SEARCHED: unsearched} if unsearched else {}
    )
