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
    kept: KeptCorners
    workers: Workers

    def fingerprint(self, rig: int) -> str:
        """The fingerprint of the content of the photographs of all cameras."""
        cameras = camera_folders(self.folders[rig])
        found = self._folders_of([str(path) for path in cameras])
        return of_words(f"{path.name} {found.fingerprint(c)}" for c, path in enumerate(cameras))

    def measure(
        self, chosen: Sequence[int], tell: Callable[[float], None]
    ) -> dict[int, tuple[RigViews, dict] | str]:
        """Some of the rigs, with what a line says of their photographs; or why there is none."""
        cameras = {i: camera_folders(self.folders[i]) for i in chosen}
        every = [(i, path) for i, of in cameras.items() for path in of]
        # All folders of all rigs at once, so that the processes are never idle.
        found = self._folders_of([str(path) for _, path in every])
        views = found.measure(range(len(every)), tell) if every else {}
        of_rig: dict[int, dict[str, BoardViews | str]] = {i: {} for i in chosen}
        for (i, path), one in zip(every, views.values()):
            of_rig[i][path.name] = one
        return {i: _rig(of) for i, of in of_rig.items()}

    def _folders_of(self, folders: Sequence[str]) -> PhotographFolders:
        return PhotographFolders(folders, self.board, self.kept, self.workers)


def _rig(views: Mapping[str, BoardViews | str]) -> tuple[RigViews, dict] | str:
    if len(views) < 2:
        said = f" (only {[*views][0]})" if views else ""
        return f"expected a folder of photographs for every camera of the rig here{said}"
    bad = [f"camera {name}: {one}" for name, one in views.items() if isinstance(one, str)]
    if bad:
        return "; ".join(bad)
    given = {name: one for name, one in views.items() if not isinstance(one, str)}
    try:
        rig = rig_of_views(given)
    except InputError as error:
        return str(error)
    failed = {f"{name}/{photo}": why for name, one in given.items() for photo, why in one.failed}
    return rig, of_unused(failed)


def rig_of_views(views: Mapping[str, BoardViews]) -> RigViews:
    """The rig of the views of its cameras.

    **Raises:** `InputError` where the photographs of two cameras cannot be paired."""
    names = {name: one.names for name, one in views.items()}
    keys = {name: list(of) for name, of in names.items()}
    if len(views) > 1:
        keys = epoch_keys(names)
    epochs = tuple(dict.fromkeys(key for name in views for key in keys[name]))
    board = next(iter(views.values())).board
    xy = np.full((len(views), len(epochs), len(board.ids), 2), np.nan)
    images = []
    for c, (name, one) in enumerate(views.items()):
        rows = [epochs.index(key) for key in keys[name]]
        xy[c, rows] = one.xy
        prefix = f"{name}/" if len(views) > 1 else ""
        photo = dict(zip(rows, one.names))
        images.append(tuple(f"{prefix}{photo.get(e, epoch)}" for e, epoch in enumerate(epochs)))
    sizes = tuple((int(one.image_size[0]), int(one.image_size[1])) for one in views.values())
    return RigViews(tuple(views), sizes, tuple(images), epochs, board.points, xy)
