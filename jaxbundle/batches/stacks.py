"""Many cameras in one file: an `.npz` with the arrays of `calibrate_batch`.

| array | shape | |
|---|---|---|
| `object_points` | [points, 3] or [cameras, points, 3] | known coordinates |
| `image_points` | [cameras, views, points, 2] | pixels |
| `image_size` | [2] | width, height |
| `visible` | [cameras, views, points] | optional: measured points; NaN is not visible either |
| `ids` | [cameras] | optional: names; otherwise 0, 1, 2, … |

Of rigs, as of `calibrate_rigs`, with an axis more: `image_points` [rigs, cameras, epochs, points,
2], `visible` [rigs, cameras, epochs, points], `ids` [rigs]; `image_size` [2] or [cameras, 2];
`cameras` [cameras], optional: their names.
"""

import dataclasses
import zipfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from jaxbundle.arguments import numeric_array
from jaxbundle.batches.calibrate_rigs import check_rigs, rigs_of_arrays
from jaxbundle.batches.input import check_shapes, single_list
from jaxbundle.batches.rigs import RigViews
from jaxbundle.errors import InputError
from jaxbundle.io.text.archives import ArchiveMember, open_archive, read_member
from jaxbundle.io.text.stored_rows import StoredRows, find_stored_rows
from jaxbundle.io.writing.fingerprints import of_arrays

EXPECTED = "a readable .npz file of plain arrays"
REQUIRED_ARRAYS = ("object_points", "image_points", "image_size")
KNOWN_ARRAYS = (*REQUIRED_ARRAYS, "visible", "ids", "cameras")
# Numbers of axes of arrays with one row per camera, or per rig.
BY_CAMERA = {"object_points": (3,), "image_points": (4, 5), "visible": (3, 4)}


@dataclasses.dataclass(frozen=True)
class CameraStack:
    """The cameras of a file; large arrays are read in place."""

    ids: tuple[str, ...]
    object_points: np.ndarray | StoredRows
    image_points: np.ndarray | StoredRows
    image_size: np.ndarray
    visible: np.ndarray | StoredRows | None
    cameras: tuple[str, ...] | None = None

    @property
    def of_rigs(self) -> bool:
        """Whether its rows are rigs, not cameras."""
        return self.image_points.ndim == 5

    def rigs(self, cameras: Sequence[int]) -> list[RigViews]:
        """Some of the rigs; a camera is a rig of one."""
        arguments = self.arguments(np.asarray(cameras))
        xy, visible = arguments["image_points"], arguments["visible"]
        if not self.of_rigs:
            xy, visible = xy[:, None], None if visible is None else visible[:, None]
        X = np.asarray(arguments["object_points"], float)
        return rigs_of_arrays(X, xy.astype(float), self.image_size, visible, self.cameras)

    def arguments(self, cameras: np.ndarray) -> dict:
        """Arguments of `calibrate_batch` for some of the cameras."""
        X = self.object_points
        return dict(
            object_points=X[cameras] if isinstance(X, StoredRows) or X.ndim == 3 else X,
            image_points=self.image_points[cameras],
            image_size=tuple(self.image_size.ravel().tolist()),
            visible=None if self.visible is None else self.visible[cameras],
        )

    def fingerprint(self, camera: int) -> str:
        """The fingerprint of the measurements of a camera, independent of invisible points and
        padding."""
        X = self.object_points
        X = X[camera] if isinstance(X, StoredRows) or X.ndim == 3 else X
        xy = self.image_points[camera]
        is_seen = ~np.isnan(xy).any(-1) & ~np.isnan(X).any(-1)
        is_seen = is_seen if self.visible is None else is_seen & (self.visible[camera] != 0)
        is_point_seen = is_seen.reshape(-1, len(X)).any(0)
        return of_arrays(
            np.argwhere(is_seen), xy[is_seen], X[is_point_seen], np.array(self.image_size.tolist())
        )


def is_camera_stack(path: str | Path) -> bool:
    """Whether the name is that of a file of many cameras."""
    return Path(path).suffix.lower() == ".npz"


def read_camera_stack(path: str | Path) -> CameraStack:
    """The cameras of an `.npz` file.

    **Raises:** `InputError` if an array is missing or its shape does not fit the others.
    """
    if not Path(path).is_file():
        raise InputError(f"{path}: no such file")
    with open_archive(path, EXPECTED, KNOWN_ARRAYS) as (archive, members):
        arrays = {name: _rows(path, archive, name, member) for name, member in members.items()}
    missing_arrays = [name for name in REQUIRED_ARRAYS if name not in arrays]
    if missing_arrays:
        raise InputError(
            f"{path}: no array {missing_arrays[0]!r}; expected {', '.join(REQUIRED_ARRAYS)} and, "
            "if needed, visible and ids"
        )
    X, xy, size = (arrays[name] for name in REQUIRED_ARRAYS)
    visible, cameras = arrays.get("visible"), _names(path, arrays, "cameras")
    try:
        for name in [n for n, array in arrays.items() if isinstance(array, np.ndarray)]:
            if name in ("ids", "cameras"):
                continue
            mask = name == "visible"
            numeric_array(name, arrays[name], "true or false" if mask else "numbers", truths=mask)
        if isinstance(X, StoredRows) and X.shape[:2] != xy.shape[:1] + xy.shape[-2:-1]:
            X = X[np.arange(len(X))]  # the points of a view each
        if xy.ndim == 5:
            cameras, _ = check_rigs(X, xy, size, visible, cameras)
        else:
            X = X if isinstance(X, StoredRows) else single_list(X, xy)
            all_visible = np.broadcast_to(np.True_, xy.shape[:3])
            check_shapes(X, xy, size, all_visible if visible is None else visible)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    names = _names(path, arrays, "ids")
    names = tuple(map(str, range(len(xy)))) if names is None else names
    if len(names) != len(xy):
        raise InputError(f"{path}: ids must have the shape ({len(xy)},), but has ({len(names)},)")
    if len({*names}) < len(xy):
        raise InputError(f"{path}: ids must differ, but some occur twice")
    return CameraStack(names, X, xy, size, visible, cameras)


def _names(path: str | Path, arrays: Mapping[str, np.ndarray], name: str) -> tuple[str, ...] | None:
    """An array of names, if there is one.

    **Raises:** `InputError` for another one."""
    array = arrays.get(name)
    if array is None:
        return None
    if array.ndim != 1:
        raise InputError(f"{path}: {name} must be a list, but has the shape {array.shape}")
    if array.dtype.kind not in "biufUS":
        raise InputError(f"{path}: {name} must be texts or numbers, but are {array.dtype}")
    # Bytes become the text they are in ASCII.
    texts = np.char.decode(array, "ascii", "replace") if array.dtype.kind == "S" else array
    return tuple(map(str, texts.tolist()))


def _rows(path: str | Path, archive: zipfile.ZipFile, name: str, member: ArchiveMember) -> Any:
    """An array, or on demand the rows of a large one with one row per camera."""
    by_camera = len(member.shape) in BY_CAMERA.get(name, ())
    # A stack may exceed the memory: rows are read from the file when needed.
    if by_camera and (member.dtype.kind == "b") == (name == "visible"):
        stored_rows = find_stored_rows(path, EXPECTED, archive, name, member)
        if stored_rows is not None:
            return stored_rows
    return read_member(path, EXPECTED, archive, name, member)
