"""Which format a path is in, and who reads it."""

import dataclasses
import os
from collections.abc import Callable, Sequence
from pathlib import Path

from jaxbundle.errors import InputError
from jaxbundle.io.bal import is_bal, read_bal
from jaxbundle.io.photo_list import read_photo_list
from jaxbundle.io.project import FILE_NAME, read_project
from jaxbundle.network.columns import did_you_mean
from jaxbundle.network.tables import Network


@dataclasses.dataclass(frozen=True)
class Format:
    """A kind of input: how it is recognised, how it is read, and what it looks like in words."""

    recognises: Callable[[Path], bool]
    read: Callable[[Path, Sequence[str]], Network]
    looks: str


def _is_project(path: Path) -> bool:
    return path.suffix.lower() == ".toml" or (path / FILE_NAME).is_file()


def _is_photo_list(path: Path) -> bool:
    """A text file whose first line is one number."""
    if path.suffix.lower() != ".txt" or not path.is_file():
        return False
    with path.open(encoding="utf-8-sig", errors="replace") as file:
        first = next((line for line in file if line.strip()), "")
    try:
        float(first)
    except ValueError:
        return False
    return True


FORMATS: dict[str, Format] = {
    "project": Format(_is_project, read_project, "a .toml file, or a folder with project.toml"),
    "photo-list": Format(
        _is_photo_list, read_photo_list, "a .txt file whose first line is the focal length"
    ),
    "bal": Format(is_bal, read_bal, "a text file (.gz, .bz2) whose first line is three numbers"),
}


def read_network(
    path: str | Path, format: str | None = None, overrides: Sequence[str] = ()
) -> Network:
    """The network of an input in any known format.

    **Arguments:**

    - `path`: a file or folder.
    - `format`: a name in `FORMATS`; recognised from the path and its content if not given.
    - `overrides`: settings `KEY=VALUE` that replace those of the input.

    **Raises:** `InputError`.
    """
    path = Path(path)
    if format is not None and format not in FORMATS:
        raise InputError(f"unknown format {format!r}{did_you_mean(format, FORMATS)}")
    if not os.path.exists(path):
        raise InputError(f"{path}: no such file or folder")
    if format is None:
        format = next((name for name, kind in FORMATS.items() if kind.recognises(path)), None)
    if format is None:
        known = "; ".join(f"{name}: {kind.looks}" for name, kind in FORMATS.items())
        raise InputError(f"{path}: the kind of input is not recognised; known formats: {known}")
    return FORMATS[format].read(path, overrides)
