"""Sparse models of COLMAP: a folder with cameras, images and points3D, binary or text."""

from collections.abc import Sequence
from pathlib import Path

from jaxbundle.errors import InputError
from jaxbundle.io.colmap_binary import binary_files, read_binary_cameras, read_binary_model
from jaxbundle.io.colmap_model import from_network, numbers_of, to_network
from jaxbundle.io.colmap_text import (
    camera_lines,
    read_text_cameras,
    read_text_model,
    text_files,
)
from jaxbundle.io.csv_tables import write_bytes
from jaxbundle.network.tables import Camera, Network

PARTS = ("cameras", "images", "points3D")
RIGS = ("rigs", "frames")
SUFFIXES = (".bin", ".txt")


def is_colmap(path: Path) -> bool:
    """Whether a folder holds cameras.bin or cameras.txt with images beside it."""
    return any((path / f"cameras{s}").is_file() and (path / f"images{s}").is_file()
               for s in SUFFIXES)  # fmt: skip


def read_colmap(path: str | Path, overrides: Sequence[str] = ()) -> Network:
    """The network of a sparse model; binary files come before text files, as in COLMAP.

    **Raises:** `InputError` naming file and line, or which entry of a binary file.
    """
    path = Path(path)
    suffix, read = next(
        ((s, r) for s, r in ((".bin", read_binary_model), (".txt", read_text_model))
         if (path / f"cameras{s}").is_file()), ("", None),
    )  # fmt: skip
    if read is None:
        raise InputError(f"{path}: there is no cameras.bin or cameras.txt in it")
    for part in PARTS:
        if not (path / f"{part}{suffix}").is_file():
            raise InputError(f"{path / part}{suffix}: no such file")
    network = to_network(path, read(path), overrides)
    if (path / f"rigs{suffix}").is_file():
        return network.warn("rigs and frames are not read: every image has a pose of its own")
    return network


def read_colmap_cameras(path: str | Path) -> tuple[Camera, ...]:
    """The cameras of a cameras.bin or cameras.txt, called by number."""
    path = Path(path)
    read = read_binary_cameras if path.suffix.lower() == ".bin" else read_text_cameras
    return tuple(read(path).values())


def write_colmap_cameras(cameras: Sequence[Camera], path: str | Path) -> None:
    """Write a cameras.txt alone; cameras as in `write_colmap`."""
    lines = camera_lines(dict(zip(numbers_of([camera.id for camera in cameras]), cameras)))
    write_bytes(Path(path), ("\n".join(lines) + "\n").encode())


def write_colmap(network: Network, folder: str | Path, text: bool = False) -> tuple[str, ...]:
    """Write a sparse model into a folder; `cameras` comes last, with it the model is complete.

    Cameras must be of model `opencv` or `kannala-brandt` and have an image size. The files of a
    model that was there in the other form are removed: they would be read first.

    **Returns:** what COLMAP has no place for, in words.
    """
    folder = Path(folder)
    model, lost = from_network(network)
    files = text_files(model) if text else binary_files(model)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for name, content in reversed(files.items()):
            write_bytes(folder / name, content)
        for name in {f"{part}{suffix}" for part in (*PARTS, *RIGS) for suffix in SUFFIXES}:
            if name not in files:
                (folder / name).unlink(missing_ok=True)
    except OSError as error:
        raise InputError(f"{folder}: cannot be written: {error.strerror}") from None
    return lost
