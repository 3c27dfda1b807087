"""Sparse models of COLMAP: a folder with cameras, images and points3D, binary or text."""

from collections.abc import Sequence
from pathlib import Path

from jaxbundle.errors import InputError
from jaxbundle.io.networks.colmap_binary import binary_files, read_binary_cameras, read_binary_model
from jaxbundle.io.networks.colmap_model import COLMAP_LOSSES, from_network, numbers_of, to_network
from jaxbundle.io.networks.colmap_rigs import (
    read_frames,
    rig_files,
    rigs_and_frames,
    rigs_of_frames,
)
from jaxbundle.io.networks.colmap_text import (
    camera_lines,
    read_text_cameras,
    read_text_model,
    text_files,
)
from jaxbundle.io.networks.losses import describe_losses
from jaxbundle.io.text.csv_tables import write_bytes
from jaxbundle.io.writing.folders import replace_folder
from jaxbundle.network.kinds import Rigs
from jaxbundle.network.tables import Camera, Network

PARTS = ("cameras", "images", "points3D")
RIGS = ("rigs", "frames")
SUFFIXES = (".bin", ".txt")
# Possible files of a model, in either form.
FILES = tuple(f"{part}{suffix}" for part in (*PARTS, *RIGS) for suffix in SUFFIXES)


def is_colmap(path: Path) -> bool:
    """Whether a folder holds cameras.bin or cameras.txt with images beside it."""
    return any(
        (path / f"cameras{s}").is_file() and (path / f"images{s}").is_file() for s in SUFFIXES
    )


def read_colmap(path: str | Path, overrides: Sequence[str] = ()) -> Network:
    """The network of a sparse model; binary files take precedence, as in COLMAP.

    **Raises:** `InputError` naming file and line, or which entry of a binary file.
    """
    path = Path(path)
    suffix, reader = next(
        (
            (s, r)
            for s, r in ((".bin", read_binary_model), (".txt", read_text_model))
            if (path / f"cameras{s}").is_file()
        ),
        ("", None),
    )
    if reader is None:
        raise InputError(f"{path}: there is no cameras.bin or cameras.txt in it")
    for part in PARTS:
        if not (path / f"{part}{suffix}").is_file():
            raise InputError(f"{path / part}{suffix}: no such file")
    model = reader(path)
    network = to_network(path, model, overrides)
    present_parts = [part for part in RIGS if (path / f"{part}{suffix}").is_file()]
    if not present_parts:
        return network
    if len(present_parts) == 1:
        missing_part = next(part for part in RIGS if part not in present_parts)
        raise InputError(
            f"{path / missing_part}{suffix}: no such file; expected it beside {present_parts[0]}"
        )
    names = {image.id: image.name for image in model.images}
    return network.replace(further=rigs_of_frames(path, read_frames(path, suffix), names))


def read_colmap_cameras(path: str | Path) -> tuple[Camera, ...]:
    """The cameras of a cameras.bin or cameras.txt, named by number.

    **Raises:** `InputError`.
    """
    path = Path(path)
    reader = read_binary_cameras if path.suffix.lower() == ".bin" else read_text_cameras
    return tuple(reader(path).values())


def write_colmap_cameras(cameras: Sequence[Camera], path: str | Path) -> None:
    """Write only a cameras.txt; cameras as in `write_colmap`."""
    lines = camera_lines(dict(zip(numbers_of([camera.id for camera in cameras]), cameras)))
    write_bytes(Path(path), ("\n".join(lines) + "\n").encode())


def write_colmap(
    network: Network, folder: str | Path, text: bool = False, force: bool = False
) -> tuple[str, ...]:
    """Write a sparse model into a folder.

    Cameras must have one of the `COLMAP_MODELS` and an image size.

    **Arguments:** `force`: also replace a model not written by this function, in either form.

    **Returns:** messages about what COLMAP cannot hold.

    **Raises:** `InputError` where the folder may not or cannot be written
    (`jaxbundle.io.writing.folders`).
    """
    with replace_folder(folder, "write_colmap", FILES, force) as new:
        return fill_colmap(network, new, text)


def fill_colmap(network: Network, folder: Path, text: bool | None = None) -> tuple[str, ...]:
    """Write a sparse model into an existing folder or a new one; as `write_colmap`. `text`
    by default if possible, that is without blanks in image names."""
    model, contradicted = from_network(network), []
    if text is None:
        text = not any(character.isspace() for image in model.images for character in image.name)
    rigs, frames = [], []
    if any(isinstance(kind, Rigs) for kind in network.further):
        rigs, frames, contradicted = rigs_and_frames(
            network, [*model.cameras], [image.id for image in model.images]
        )
    files = (text_files(model) if text else binary_files(model)) | rig_files(rigs, frames, text)
    folder.mkdir(exist_ok=True)
    for name, content in files.items():
        write_bytes(folder / name, content)
    return (*describe_losses(network, COLMAP_LOSSES), *contradicted)
