"""Which format a path is in, who reads it, and who writes it."""

import dataclasses
import os
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

from jaxbundle.arguments import path as given_path
from jaxbundle.arguments import shown
from jaxbundle.cameras import CameraModel
from jaxbundle.errors import InputError
from jaxbundle.io.cameras.camera_files import is_camera_file
from jaxbundle.io.networks.bal import OPENERS, is_bal, read_bal, write_bal
from jaxbundle.io.networks.bingo import is_bingo, read_bingo
from jaxbundle.io.networks.bundler import is_bundler, read_bundler, write_bundler
from jaxbundle.io.networks.colmap import FILES as COLMAP_FILES
from jaxbundle.io.networks.colmap import fill_colmap, is_colmap, read_colmap
from jaxbundle.io.networks.column_map import is_column_map, read_column_map
from jaxbundle.io.networks.control import read_control, with_control
from jaxbundle.io.networks.metashape import is_metashape, read_metashape
from jaxbundle.io.networks.photo_list import read_photo_list
from jaxbundle.io.networks.photomodeler import is_photomodeler, read_photomodeler
from jaxbundle.io.networks.project import FILE_NAME, fill_project, project_file, read_project
from jaxbundle.io.networks.project import FILES as PROJECT_FILES
from jaxbundle.io.results.coordinates import write_coordinates
from jaxbundle.io.results.dxf import write_dxf
from jaxbundle.io.results.ply import write_ply
from jaxbundle.network.columns import count, did_you_mean, some
from jaxbundle.network.rules import check_unique, model_of
from jaxbundle.network.tables import Network, Source
from jaxbundle.system.file_content import is_plain

FIRST_LINES = 100_000
"""Characters of a file that tell what it is."""


@dataclasses.dataclass(frozen=True)
class Format:
    """A kind of input: how it is recognised, how it is read, and what it looks like in words;
    `adjusted` where its control points have adjusted coordinates and a posteriori σ; `names_models`
    where cameras name their models, and `read` takes own ones."""

    recognises: Callable[[Path], bool]
    read: Callable[..., Network]
    looks: str
    adjusted: bool = False
    names_models: bool = False


@dataclasses.dataclass(frozen=True)
class Target:
    """A kind of output: names it is recognised by, who writes it, and the camera models it has.

    `write` returns what is not kept, in words; no `models`: all. `files`: names of what is written
    into a folder; none: a file is written.
    """

    recognises: Callable[[Path], bool]
    write: Callable[[Network, Path], Sequence[str]]
    looks: str
    models: tuple[str, ...] = ()
    files: tuple[str, ...] = ()


def _is_project(path: Path) -> bool:
    if path.suffix.lower() == ".toml":
        return not is_column_map(path)
    return path.is_dir() and project_file(path).is_file()


def _is_photo_list(path: Path) -> bool:
    """A text file whose first line is one number."""
    if path.suffix.lower() != ".txt" or not is_plain(path):
        return False
    with path.open(encoding="utf-8-sig", errors="replace") as file:
        first = next((line for line in file.read(FIRST_LINES).split("\n") if line.strip()), "")
    try:
        float(first)
    except ValueError:
        return False
    return True


FORMATS: dict[str, Format] = {
    "project": Format(
        _is_project, read_project, "a .toml file, or a folder with project.toml", names_models=True
    ),
    "photo-list": Format(
        _is_photo_list, read_photo_list, "a .txt file whose first line is the focal length"
    ),
    "bal": Format(is_bal, read_bal, "a text file (.gz, .bz2) whose first line is three numbers"),
    "column-map": Format(
        is_column_map, read_column_map, "a .toml file with [table.…] sections", names_models=True
    ),
    "colmap": Format(is_colmap, read_colmap, "a folder with cameras.bin or cameras.txt"),
    "bingo": Format(is_bingo, read_bingo, "a folder with image.dat and geoin.dat"),
    "metashape": Format(is_metashape, read_metashape, "an .xml file of Metashape's cameras"),
    "photomodeler": Format(
        is_photomodeler, read_photomodeler, 'a .txt file that begins with "Bundle Soln"',
        adjusted=True,
    ),
    "bundler": Format(is_bundler, read_bundler, 'a file that begins with "# Bundle file"'),
}


def _write_project(network: Network, path: Path) -> Sequence[str]:
    fill_project(network, path)
    return ()


def _ends(*suffixes: str) -> Callable[[Path], bool]:
    return lambda path: path.suffix.lower() in suffixes


def _is_colmap_name(path: Path) -> bool:
    return not path.suffix and any(
        word in part.lower() for part in path.parts[-2:] for word in ("colmap", "sparse")
    )


def _is_bal_name(path: Path) -> bool:
    return path.suffix.lower() in (".txt", ".bal", *OPENERS)


PIXEL_MODELS = ("opencv", "kannala-brandt")
TARGETS: dict[str, Target] = {
    "ply": Target(_ends(".ply"), write_ply, "NAME.ply"),
    "dxf": Target(_ends(".dxf"), write_dxf, "NAME.dxf"),
    "csv": Target(_ends(".csv"), write_coordinates, "NAME.csv"),
    "bundler": Target(_ends(".out"), write_bundler, "NAME.out", ("snavely",)),
    "bal": Target(_is_bal_name, write_bal, "NAME.txt, .bal, .gz, .bz2", ("snavely",)),
    "colmap": Target(
        _is_colmap_name, partial(fill_colmap, text=False), "a folder with colmap or sparse in its "
        "name", PIXEL_MODELS, COLMAP_FILES,
    ),
    "colmap-text": Target(
        lambda path: False, partial(fill_colmap, text=True), "by --to only", PIXEL_MODELS,
        COLMAP_FILES,
    ),
    "project": Target(
        lambda path: not path.suffix or path.is_dir() or path.name == FILE_NAME, _write_project,
        "another folder", files=PROJECT_FILES,
    ),
}  # fmt: skip


def recognised_format(path: Path) -> str | None:
    """The kind of an input, from its name and content; None where none fits."""
    return next((name for name, kind in FORMATS.items() if kind.recognises(path)), None)


def read_network(
    path: str | Path,
    format: str | None = None,
    overrides: Sequence[str] = (),
    control: str | Path | None = None,
    models: Sequence[CameraModel] = (),
) -> Network:
    """The network of an input in any known format.

    **Arguments:**

    - `path`: a file or folder.
    - `format`: a name in `FORMATS`; recognised from the path and its content if not given.
    - `overrides`: settings `KEY=VALUE` that replace those of the input.
    - `control`: a table whose control points replace those of the input (`networks.control`).
    - `models`: `CameraModel`s of one's own that a project, or a column map, may name.

    **Raises:** `InputError`.
    """
    path = Path(given_path("path", path))
    if isinstance(overrides, str) or not (
        isinstance(overrides, Sequence) and all(isinstance(text, str) for text in overrides)
    ):
        raise InputError(
            f"overrides must be a list of texts, such as ['datum=inner'], but is {shown(overrides)}"
        )
    if format is not None and format not in FORMATS:
        if format in TARGETS or format == "opencv":
            what = "holds a camera alone" if format == "opencv" else "is written only"
            raise InputError(
                f"--format {format}: {what}; a network is read as {', '.join(FORMATS)}"
            )
        raise InputError(f"unknown format {format!r}{did_you_mean(format, FORMATS)}")
    if not os.path.exists(path):
        raise InputError(f"{path}: no such file or folder")
    format = format or recognised_format(path)
    if format is None and is_camera_file(path):
        raise InputError(
            f"{path}: holds cameras alone, without images and points; a project, or another "
            "network, is expected (jaxbundle camera, compare and convert read it)"
        )
    if format is None:
        known = "; ".join(f"{name}: {kind.looks}" for name, kind in FORMATS.items())
        raise InputError(f"{path}: the kind of input is not recognised; known formats: {known}")
    given = None if control is None else read_control(control)
    own = (check_own_models(models),) if FORMATS[format].names_models else ()
    network = FORMATS[format].read(path, overrides, *own)
    if given is not None:
        datum = any(text.partition("=")[0].strip() == "datum" for text in overrides)
        return with_control(network, given, datum=not datum)
    return network.warn(*_of_adjusted_control(network)) if FORMATS[format].adjusted else network


def check_own_models(models: Sequence[CameraModel]) -> tuple[CameraModel, ...]:
    """Own models that a file may name, each of them once.

    **Raises:** `InputError`."""
    if not (isinstance(models, list | tuple) and all(isinstance(m, CameraModel) for m in models)):
        raise InputError(f"models must be a list of CameraModels, but is {shown(models)}")
    check_unique([model_of(m).name for m in models], Source("models", None, "number"), "model")
    return tuple(models)


def _of_adjusted_control(network: Network):
    """What is to be said of control that an adjustment has already moved, and of what is held."""
    points = network.points
    held = [id for id, role in zip(points.id, points.role) if role == "fixed"]
    weighted = points.role.count("control")
    if held:
        yield f"{count(len(held), 'control point')} without positive σ held as fixed: {some(held)}"
    if weighted:
        yield (
            f"the file gives {count(weighted, 'control point')} with adjusted coordinates and a "
            "posteriori σ; adjusted again, control counts twice and σ0 is too small. Give the "
            "control as it was measured: --control FILE (id,X,Y,Z,sX,sY,sZ)"
        )
