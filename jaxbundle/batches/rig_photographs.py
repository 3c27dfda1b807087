"""Rigs of a batch from folders of photographs: a folder a rig, in it a folder a camera.

Simultaneous photographs have equal names, or equal last numbers in them (`epochs`). The first
camera in the order of their names is the reference.
"""

import dataclasses
from collections.abc import Callable, Mapping, Sequence

import numpy as np

from jaxbundle.batches.epochs import epoch_keys
from jaxbundle.batches.photographs import PhotographFolders, camera_folders, of_unused
from jaxbundle.batches.rigs import RigViews
from jaxbundle.errors import InputError
from jaxbundle.io.boards.kept_corners import KeptCorners
from jaxbundle.io.writing.fingerprints import of_words
from jaxbundle.measure.boards import Board
from jaxbundle.measure.views import BoardViews
from jaxbundle.system.workers import Workers


@dataclasses.dataclass(frozen=True)
class RigFolders:
    """Folders of rigs before one board, what was found in them, and who searches."""

    folders: Sequence[str]
    board: Board
    kept_corners: KeptCorners
    workers: Workers

    def fingerprint(self, rig: int) -> str:
        """The fingerprint of the content of the photographs of all cameras."""
        cameras = camera_folders(self.folders[rig])
        folders_of_cameras = self._folders_of([str(path) for path in cameras])
        return of_words(
            f"{path.name} {folders_of_cameras.fingerprint(c)}" for c, path in enumerate(cameras)
        )

    def measure(
        self, rigs: Sequence[int], tell: Callable[[float], None]
    ) -> dict[int, tuple[RigViews, dict] | str]:
        """Some of the rigs, with what a line says of their photographs; or why there is none."""
        cameras = {i: camera_folders(self.folders[i]) for i in rigs}
        all_folders = [
            (i, path) for i, folders_of_rig in cameras.items() for path in folders_of_rig
        ]
        # All folders of all rigs at once, so that the processes are never idle.
        photograph_folders = self._folders_of([str(path) for _, path in all_folders])
        views = photograph_folders.measure(range(len(all_folders)), tell) if all_folders else {}
        of_rig: dict[int, dict[str, BoardViews | str]] = {i: {} for i in rigs}
        for (i, path), views_or_reason in zip(all_folders, views.values()):
            of_rig[i][path.name] = views_or_reason
        return {i: _rig(views_of_rig) for i, views_of_rig in of_rig.items()}

    def _folders_of(self, folders: Sequence[str]) -> PhotographFolders:
        return PhotographFolders(folders, self.board, self.kept_corners, self.workers)


def _rig(views: Mapping[str, BoardViews | str]) -> tuple[RigViews, dict] | str:
    if len(views) < 2:
        only_camera = f" (only {[*views][0]})" if views else ""
        return f"expected a folder of photographs for every camera of the rig here{only_camera}"
    reasons = [
        f"camera {name}: {views_of_camera}"
        for name, views_of_camera in views.items()
        if isinstance(views_of_camera, str)
    ]
    if reasons:
        return "; ".join(reasons)
    usable_views = {
        name: views_of_camera
        for name, views_of_camera in views.items()
        if not isinstance(views_of_camera, str)
    }
    try:
        rig = rig_of_views(usable_views)
    except InputError as error:
        return str(error)
    failures = {
        f"{name}/{photo}": why
        for name, views_of_camera in usable_views.items()
        for photo, why in views_of_camera.failed
    }
    return rig, of_unused(failures)


def rig_of_views(views: Mapping[str, BoardViews]) -> RigViews:
    """The rig of the views of its cameras.

    **Raises:** `InputError` where the photographs of two cameras cannot be paired."""
    names = {name: views_of_camera.names for name, views_of_camera in views.items()}
    keys = {name: list(names_of_camera) for name, names_of_camera in names.items()}
    if len(views) > 1:
        keys = epoch_keys(names)
    epochs = tuple(dict.fromkeys(key for name in views for key in keys[name]))
    board = next(iter(views.values())).board
    xy = np.full((len(views), len(epochs), len(board.ids), 2), np.nan)
    images = []
    for c, (name, views_of_camera) in enumerate(views.items()):
        rows = [epochs.index(key) for key in keys[name]]
        xy[c, rows] = views_of_camera.xy
        prefix = f"{name}/" if len(views) > 1 else ""
        photo = dict(zip(rows, views_of_camera.names))
        images.append(tuple(f"{prefix}{photo.get(e, epoch)}" for e, epoch in enumerate(epochs)))
    sizes = tuple(
        (int(views_of_camera.image_size[0]), int(views_of_camera.image_size[1]))
        for views_of_camera in views.values()
    )
    return RigViews(tuple(views), sizes, tuple(images), epochs, board.points, xy)
