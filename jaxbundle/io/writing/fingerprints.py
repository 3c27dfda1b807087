"""Short fingerprints of inputs: the same content, the same 16 hex digits."""

import hashlib
import os
from collections.abc import Iterable, Iterator
from functools import partial
from glob import escape
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np

from jaxbundle.errors import InputError
from jaxbundle.io.cameras.slam_yaml import read_yaml_fields
from jaxbundle.io.networks.project import project_file
from jaxbundle.io.text.csv_tables import read_text, read_toml
from jaxbundle.io.text.json_fields import read_object
from jaxbundle.system.file_content import is_plain

# Files of a folder that hold a network (COLMAP, BINGO, OpenSfM, MicMac, mrcal, RealityScan,
# camera_info); photographs do not count.
NETWORK_SUFFIXES = {
    ".bin",
    ".cameramodel",
    ".csv",
    ".dat",
    ".json",
    ".toml",
    ".txt",
    ".xml",
    ".xmp",
    ".yaml",
    ".yml",
}
# Those of its folders (EuRoC).
IN_FOLDERS = "cam*/sensor.yaml"
# Files that are read with a file of a name or a suffix and not named in it; {stem}: its name.
COMPANIONS = {
    "reconstruction.json": ("tracks.csv", "ground_control_points.json", "reference_lla.json"),
    ".imd": ("{stem}.[eE][pP][hH]", "{stem}.[aA][tT][tT]", "{stem}.[gG][eE][oO]"),
    ".out": ("list.txt",),
    ".phc": ("{stem}.ior", "{stem}.eor", "{stem}.obc", "{stem}.scale"),
    ".psx": (
        "{stem}.files/project.zip",
        "{stem}.files/*/chunk.zip",
        "{stem}.files/*/*/frame.zip",
        "{stem}.files/*/*/point_cloud/point_cloud.zip",
    ),
}

_hash = partial(hashlib.blake2b, digest_size=8)


def of_arrays(*arrays: np.ndarray) -> str:
    """The fingerprint of numbers in their shapes, regardless of type."""
    digest = _hash()
    for array in arrays:
        digest.update(repr(array.shape).encode())
        digest.update(np.ascontiguousarray(array, "<f8").tobytes())
    return digest.hexdigest()


def of_words(words: Iterable[str]) -> str:
    """The fingerprint of texts in their order."""
    digest = _hash()
    for word in words:
        digest.update(word.encode(errors="surrogateescape") + b"\n")
    return digest.hexdigest()


def of_input(path: str | Path) -> str:
    """The fingerprint of an input of `read_network`: of its files, not of their paths.

    Unreadable files count as empty.
    """
    digest = _hash()
    for file in input_files(path):
        digest.update(file.name.encode(errors="surrogateescape"))
        try:
            if not is_plain(file):
                continue
            with file.open("rb") as stream:
                digest.update(hashlib.file_digest(stream, _hash).digest())
        except OSError:
            continue
    return digest.hexdigest()


def input_files(path: str | Path) -> Iterator[Path]:
    """The files of an input of `read_network`: itself and named files, or those of its folder."""
    project = project_file(Path(path))
    return _named_files(project if project.is_file() else Path(path))


def files_read(path: str | Path) -> list[Path]:
    """An input in TOML, the files it names, and those named by these."""
    file_by_path, pending = {}, [Path(path)]
    while pending:
        file = pending.pop()
        if (real := os.path.realpath(file)) not in file_by_path:
            file_by_path[real] = file
            pending += _named_files(file)
    return [*file_by_path.values()]


def _named_files(path: Path) -> Iterator[Path]:
    """A file and those it names, or the files of a folder."""
    if path.is_dir():
        yield from sorted(
            file for file in path.iterdir() if file.suffix.lower() in NETWORK_SUFFIXES
        )
        yield from sorted(path.glob(IN_FOLDERS))
        return
    yield path
    name, suffix = path.name.lower(), path.suffix.lower()
    for pattern in COMPANIONS.get(name, COMPANIONS.get(suffix, ())):
        yield from sorted(path.parent.glob(pattern.format(stem=escape(path.stem))))
    try:
        document = _document(path)
    except InputError:
        return
    for text in _texts(document):
        # Those of an OPF are addresses, in which a blank is %20.
        for name in dict.fromkeys((text, unquote(text))):
            file = path.parent / name
            if os.path.isfile(file):
                # The points of an OPF name the files of their numbers.
                yield from _named_files(file) if file.suffix.lower() == ".gltf" else (file,)


def _document(path: Path) -> Any:
    """The content of a file that may name others; None of any other."""
    match path.suffix.lower():
        case ".toml":
            return read_toml(path)
        case ".yaml" | ".yml":
            return read_yaml_fields(path).document
        case ".opf" | ".gltf":
            return read_object(path, read_text(path), "JSON")
    return None


def _texts(value: Any) -> Iterator[str]:
    if isinstance(value, str):
        yield value
    elif isinstance(value, dict | list):
        for part in value.values() if isinstance(value, dict) else value:
            yield from _texts(part)
