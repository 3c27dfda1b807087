"""Many cameras in one file: an `.npz` with the arrays of `calibrate_batch`.

| array | shape | |
|---|---|---|
| `object_points` | [points, 3] or [cameras, points, 3] | known coordinates |
| `image_points` | [cameras, views, points, 2] | pixels |
| `image_size` | [2] | width, height |
| `visible` | [cameras, views, points] | optional: what was measured; NaN is not visible either |
| `ids` | [cameras] | optional: names; otherwise 0, 1, 2, … |
"""

import dataclasses
import os
import zipfile
import zlib
from pathlib import Path
from typing import BinaryIO

import numpy as np

from jaxbundle.arguments import numeric_array
from jaxbundle.batch.input import check_shapes, once
from jaxbundle.errors import InputError
from jaxbundle.io.text.unpacking import most_unpacked
from jaxbundle.io.writing.fingerprints import of_arrays

UNREADABLE = (
    OSError, EOFError, ValueError, KeyError, NotImplementedError, RuntimeError, MemoryError,
    zipfile.BadZipFile, zlib.error,
)  # fmt: skip
"""What numpy and zipfile raise for an archive that is cut, garbled, or claims too much."""

NEEDED = ("object_points", "image_points", "image_size")
KNOWN = (*NEEDED, "visible", "ids")


@dataclasses.dataclass(frozen=True)
class CameraStack:
    """The cameras of a file."""

    ids: tuple[str, ...]
    object_points: np.ndarray
    image_points: np.ndarray
    image_size: tuple[float, ...]
    visible: np.ndarray | None

    def arguments(self, chosen: np.ndarray) -> dict:
        """Arguments of `calibrate_batch` for some of the cameras."""
        single = self.object_points.ndim == 2
        return dict(
            object_points=self.object_points if single else self.object_points[chosen],
            image_points=self.image_points[chosen],
            image_size=self.image_size,
            visible=None if self.visible is None else self.visible[chosen],
        )

    def fingerprint(self, camera: int) -> str:
        """Of what was measured of a camera; what is not visible does not count, nor how much room
        there is for it."""
        X = self.object_points if self.object_points.ndim == 2 else self.object_points[camera]
        xy = self.image_points[camera]
        seen = ~np.isnan(xy).any(-1) & ~np.isnan(X).any(-1)
        seen = seen if self.visible is None else seen & (self.visible[camera] != 0)
        return of_arrays(
            np.argwhere(seen), xy[seen], X[seen.any(0)], np.array(self.image_size)
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
    try:
        with open(path, "rb") as stream:
            if not zipfile.is_zipfile(stream):
                raise zipfile.BadZipFile("it is no archive")
            _check_size(stream)
            with np.load(stream, allow_pickle=False) as file:
                arrays = {name: file[name] for name in KNOWN if name in file}
    except UNREADABLE as error:
        why = " ".join(str(error).split())[:200]
        raise InputError(f"{path}: not a readable .npz file of plain arrays ({why})") from None
    missing = [name for name in NEEDED if name not in arrays]
    if missing:
        raise InputError(
            f"{path}: no array {missing[0]!r}; expected {', '.join(NEEDED)} and, if needed, "
            "visible and ids"
        )
    X, xy, size = (arrays[name] for name in NEEDED)
    visible = arrays.get("visible")
    try:
        for name in {*arrays} - {"ids"}:
            mask = name == "visible"
            numeric_array(name, arrays[name], "true or false" if mask else "numbers", truths=mask)
        X = once(X, xy)
        check_shapes(X, xy, size, np.ones(xy.shape[:3]) if visible is None else visible)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    ids = arrays.get("ids", np.arange(len(xy)))
    if ids.shape != (len(xy),):
        raise InputError(f"{path}: ids must have the shape ({len(xy)},), but has {ids.shape}")
    if ids.dtype.kind not in "biufUS":
        raise InputError(f"{path}: ids must be texts or numbers, but are {ids.dtype}")
    # Bytes become the text they are in ASCII.
    names = np.char.decode(ids, "ascii", "replace") if ids.dtype.kind == "S" else ids
    names = tuple(map(str, names.tolist()))
    if len({*names}) < len(xy):
        raise InputError(f"{path}: ids must differ, but some occur twice")
    return CameraStack(names, X, xy, tuple(size.tolist()), visible)


def _check_size(stream: BinaryIO) -> None:
    """Refuse an archive whose arrays unpack to far more than measurements do."""
    with zipfile.ZipFile(stream) as archive:
        unpacked = sum(
            member.file_size for member in archive.infolist()
            if member.filename.removesuffix(".npy") in KNOWN
        )  # fmt: skip
    size = stream.seek(0, os.SEEK_END)
    stream.seek(0)
    if unpacked > most_unpacked(size):
        raise ValueError(f"{size} bytes that claim to unpack to {unpacked}")
