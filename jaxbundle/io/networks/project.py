"""The project format: a TOML file with settings and cameras, tables in CSV files beside it.

```toml
[project]
name = "Image 63"
object_unit = "m"
image_unit = "mm"                   # or "px": (0, 0) the centre of the upper-left pixel
angle_unit = "deg"                  # rad | deg | gon
sigma_image = 0.015                 # σ of image coordinates without their own, in image_unit
sigma_origin = "stated"             # stated | unit (of weight) | estimated (from the residuals)
datum = "control"                   # control | inner | minimal
datum_points = ["1", "2", "3"]      # which points carry inner constraints; all tie points if absent
residuals = "corrected"             # corrected | measured
images = "images.csv"               # the columns of each table: `jaxbundle.network.build`
points = "points.csv"
observations = "observations.csv"
distances = "distances.csv"         # optional

[[camera]]
id = "rc30"
model = "brown"
image_size = [15333, 15333]         # pixels
pixel_size = [0.015, 0.015]         # mm
c = 154.006                         # every parameter not given starts at 0
free = ["c", "x0", "y0", "K1"]
sigma = { c = 0.1 }                 # prior σ of the start value
```

Small tables may be part of the file, one `[[image]]`, `[[point]]`, `[[observation]]`,
`[[distance]]` per row.
"""

import dataclasses
import itertools
import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
from jaxtyping import Float

from jaxbundle.arguments import path as given_path
from jaxbundle.cameras import CameraModel, is_own
from jaxbundle.errors import InputError
from jaxbundle.io.networks.settings import (
    REQUIRED_TABLES,
    SETTINGS,
    TABLES,
    Document,
    apply_overrides,
    network_of,
)
from jaxbundle.io.text.csv_tables import read_csv, read_toml, write_csv, write_text
from jaxbundle.io.text.toml_text import assignments
from jaxbundle.io.writing.folders import replace_folder
from jaxbundle.network.build import (
    DISTANCE_COLUMNS,
    IMAGE_COLUMNS,
    IMAGE_SIGMAS,
    OBSERVATION_COLUMNS,
    OBSERVATION_SIGMAS,
    POINT_COLOURS,
    POINT_COLUMNS,
    POINT_SIGMAS,
)
from jaxbundle.network.columns import Columns, as_columns, refuse_unknown
from jaxbundle.network.kinds import KINDS, SECTIONS
from jaxbundle.network.kinds.base import included_tables
from jaxbundle.network.rules import AXES
from jaxbundle.network.tables import STATED, UNIT, Camera, Network, Source, require_network
from jaxbundle.network.units import ANGLE_UNITS, to_image_unit
from jaxbundle.system.file_content import check_plain

FILE_NAME = "project.toml"
# The folder of the adjusted network beside the tables of a result.
ADJUSTED = "network"
# The files of a project.
FILES = (FILE_NAME, *(f"{table}.csv" for table in TABLES))
# The tables and the name of one of their rows in the TOML file.
INLINE = {
    table: table.removesuffix("s")
    for table in TABLES
    if table not in KINDS or not KINDS[table].SECTION
}

# Tables not required for oriented images, and their columns.
OPTIONAL_WHERE_ORIENTED = {
    "points": ("id", "role", *AXES),
    "observations": ("image", "point", "x", "y"),
}


def read_project(
    path: str | Path,
    overrides: Sequence[str] = (),
    models: Sequence[CameraModel] = (),
    oriented: bool = False,
) -> Network:
    """The network of a project file, or of that in a folder (`project_file`).

    `overrides` are settings `KEY=VALUE` that replace those of the file, see
    `jaxbundle.io.networks.settings`; `models` own camera models that the file may name;
    `oriented`: points and observations are not required.

    **Raises:** `InputError` naming file, line and column.
    """
    path = project_file(Path(path))
    document = apply_overrides(_read_document(path), overrides, (*SETTINGS, *TABLES))
    _resolve_files(document, path.parent)
    document["project"].setdefault("name", path.resolve().parent.name)
    tables = {
        table: _read_table(document, table, path)
        for table in TABLES
        if not (oriented and table in OPTIONAL_WHERE_ORIENTED and _is_absent(document, table))
    }
    for table, columns in OPTIONAL_WHERE_ORIENTED.items() if oriented else ():
        optional_table = tables.get(table)
        if optional_table is None:
            optional_table = Columns(dict.fromkeys(columns, ()), Source(table))
        tables[table] = dataclasses.replace(optional_table, may_be_empty=True)
    # Points of a model without image points can be written for other programs.
    if (rays := tables.get("observations")) is not None:
        tables["observations"] = dataclasses.replace(rays, may_be_empty=True)
    return network_of(
        document, {k: v for k, v in tables.items() if v is not None}, str(path), models
    )


def _resolve_files(document: Document, folder: Path) -> None:
    """Files that sections name are relative to the project."""
    for kind in KINDS.values():
        for entry in document.get(kind.SECTION, {}).values() if kind.FILES else ():
            for key in kind.FILES:
                if isinstance(entry, dict) and isinstance(entry.get(key), str):
                    entry[key] = str(folder / entry[key])


def _is_absent(document: Document, table: str) -> bool:
    return document["project"].get(table) is None and document.get(INLINE.get(table, "")) is None


def project_file(path: Path) -> Path:
    """The project file of a path: the path, or the file in a folder.

    In a folder written by `jaxbundle adjust --out` it is that of the adjusted network.
    """
    if not path.is_dir():
        return path
    candidates = (path / FILE_NAME, path / ADJUSTED / FILE_NAME)
    return next((candidate for candidate in candidates if candidate.is_file()), candidates[0])


def _read_document(path: Path) -> Document:
    document = read_toml(path)
    for key, value in document.items():
        refuse_unknown(key, ("project", "camera", *INLINE.values(), *SECTIONS), f"{path}: ")
        if key in SECTIONS and not isinstance(value, dict):
            table = next(table for table, kind in KINDS.items() if kind.SECTION == key)
            raise InputError(
                f"{path}: write [{key}] in single brackets; its rows are in {table}.csv"
            )
        if key not in ("project", *SECTIONS) and not (
            isinstance(value, list) and all(isinstance(row, dict) for row in value)
        ):
            raise InputError(f"{path}: write [[{key}]] in double brackets, one for each {key}")
    if not isinstance(document.get("project"), dict):
        raise InputError(f"{path}: the section [project] is missing")
    return {"camera": [], **document}


def _read_table(document: Document, table: str, path: Path) -> Columns | None:
    """A table from its CSV file or from the document; None if it is neither required nor
    given."""
    key, file = INLINE.get(table), document["project"].get(table)
    if key is not None and document.get(key) is not None:
        if file is not None:
            raise InputError(f"{path}: give either {table} = {file!r} or [[{key}]], not both")
        columns = as_columns(document[key], table)
        return Columns(columns.values, Source(f"{path} [[{key}]]", None, "entry"))
    if file is None:
        if table not in REQUIRED_TABLES:
            return None
        raise InputError(
            f'{path}, [project]: {table} is missing; give {table} = "{table}.csv" or '
            f"[[{INLINE[table]}]] entries"
        )
    if not isinstance(file, str):
        raise InputError(f"{path}, [project]: {table} is {file!r}; expected the name of a file")
    check_plain(path.parent / file)
    if not os.path.isfile(path.parent / file):
        raise InputError(
            f"{path}, [project]: {table} = {file!r}: no such file {path.parent / file}"
        )
    return read_csv(path.parent / file)


def write_project(
    network: Network, folder: str | Path, *, force: bool = False, by: str = "write_project"
) -> Path:
    """Write `project.toml` and its tables into a folder; returns the path of the former.

    Reading it again gives the same network (its warnings and notes are comments in the file).

    **Arguments:** `force`: also replace files not written by `by`, the command or function.

    **Raises:** `InputError` where the folder may not or cannot be written
    (`jaxbundle.io.writing.folders`).
    """
    network, folder = require_network(network), Path(given_path("folder", folder))
    with replace_folder(folder, by, FILES, force) as new:
        fill_project(network, new)
    return folder / FILE_NAME


def fill_project(network: Network, folder: Path) -> None:
    """Write `project.toml` and its tables into an existing folder or a new one."""
    images, points, rays = network.images, network.points, network.observations
    xy, sigma = to_image_unit(
        network.cameras, images.camera[rays.image], rays.xy, rays.sigma, network.image_unit
    )
    folder.mkdir(exist_ok=True)
    radians = ANGLE_UNITS[network.angle_unit]
    unit = np.array([1, 1, 1, radians, radians, radians])
    exterior = np.concatenate([images.position, images.angles], 1) / unit
    camera_id = [network.cameras[c].id for c in images.camera]
    _write_table(
        folder / "images.csv",
        IMAGE_COLUMNS,
        (images.id, camera_id),
        exterior,
        IMAGE_SIGMAS,
        images.sigma / unit,
        {0.0: "fixed"},
    )
    _write_table(
        folder / "points.csv",
        POINT_COLUMNS,
        (points.id, points.role),
        points.position,
        POINT_SIGMAS,
        points.sigma,
        {np.inf: "free"},
        dict(zip(POINT_COLOURS, () if points.colour is None else points.colour.T)),
    )
    origin = rays.sigma_origin
    # 1e-12: the conversion between pixels and millimetres rounds 1 to a few eps (2e-16)
    if origin == UNIT and np.allclose(sigma, 1.0, rtol=1e-12, atol=0):
        # Nobody gave them: where none are written, they are units of weight again.
        sigma, origin = np.full_like(sigma, np.nan), STATED
    _write_table(
        folder / "observations.csv",
        OBSERVATION_COLUMNS,
        ([images.id[i] for i in rays.image], [points.id[p] for p in rays.point]),
        xy,
        OBSERVATION_SIGMAS,
        sigma,
        {},
    )
    distances = network.distances
    if len(distances):
        ends = [[points.id[p] for p in column] for column in distances.points.T]
        values = np.stack([distances.value, distances.sigma], 1)
        _write_table(folder / "distances.csv", DISTANCE_COLUMNS, ends, values, (), values, {})
    for kind in included_tables(network):
        columns = {
            name: column
            if isinstance(column, tuple)
            else [x if isinstance(x, str) else "" if x != x else repr(float(x)) for x in column]
            for name, column in kind.columns(radians).items()
        }
        write_csv(folder / f"{kind.TABLE}.csv", tuple(columns), zip(*columns.values()))
    write_text(folder / FILE_NAME, _document_text(network, origin))


def _write_table(
    path: Path,
    header: Sequence[str],
    ids: Sequence[Sequence[str]],
    values: Float[np.ndarray, "rows n"],
    sigma_header: Sequence[str],
    sigma: Float[np.ndarray, "rows m"],
    words: Mapping[float, str],
    extra_columns: Mapping[str, np.ndarray] = MappingProxyType({}),
) -> None:
    """Ids, numbers and σ if given; `words` replace special values of σ; `extra_columns`
    follow."""
    with_sigma = bool(sigma_header) and not np.isnan(sigma).all()
    extra_rows = (
        zip(*(column.tolist() for column in extra_columns.values()))
        if extra_columns
        else itertools.repeat(())
    )
    rows = (
        (*names, *_cells(row), *(_cells(s, words) if with_sigma else ()), *extra_cells)
        for *names, row, s, extra_cells in zip(*ids, values.tolist(), sigma.tolist(), extra_rows)
    )
    write_csv(path, (*header, *(sigma_header if with_sigma else ()), *extra_columns), rows)


def _cells(
    numbers: Iterable[float], words: Mapping[float, str] = MappingProxyType({})
) -> Iterator[str]:
    # x != x: NaN, an empty cell
    return (words[x] if x in words else "" if x != x else repr(x) for x in numbers)


def _document_text(network: Network, origin: str) -> str:
    messages = (*network.warnings, *network.notes)
    lines = [f"# {' '.join(line.split())}" for line in messages]
    # Every σ stands in observations.csv.
    in_tables = "sigma_image", "sigma_origin"
    settings = {key: getattr(network, key) for key in SETTINGS if key not in in_tables}
    if origin != STATED:
        settings["sigma_origin"] = origin
    kinds = included_tables(network)
    distances = ["distances"] * (len(network.distances) > 0)
    tables = [*REQUIRED_TABLES, *distances, *(f.TABLE for f in kinds)]
    settings |= {table: f"{table}.csv" for table in tables}
    if not network.datum_points:
        del settings["datum_points"]
    lines += ["[project]", *assignments(settings)]
    for kind in kinds:
        if kind.SECTION and kind.settings:
            lines += ["", f"[{kind.SECTION}]", *assignments(kind.settings)]
    return "\n".join(lines) + "\n\n" + cameras_text(network.cameras)


def cameras_text(cameras: Sequence[Camera]) -> str:
    """Cameras as the `[[camera]]` entries of a TOML file."""
    lines = []
    for camera in cameras:
        if is_own(camera.model):  # a file can name the model, but not hold its formula
            lines.append(
                f"# {str(camera.model)!r} is a model of the user's own: give the object to "
                "jaxbundle.read_network(path, models=[…])"
            )
        lines += ["[[camera]]", *assignments(_camera_entry(camera)), ""]
    return "\n".join(lines)


def _camera_entry(camera: Camera) -> dict[str, Any]:
    entry: dict[str, Any] = {"id": camera.id, "model": str(camera.model)}
    for name in ("image_size", "pixel_size"):
        if getattr(camera, name) is not None:
            entry[name] = getattr(camera, name)
    entry |= {name: float(value) for name, value in camera.parameters.items()}
    entry["free"] = camera.free
    if camera.tie:
        entry["tie"] = camera.tie
    if camera.sigma:
        entry["sigma"] = {name: float(value) for name, value in camera.sigma.items()}
    if camera.observed:
        entry["observed"] = {name: float(value) for name, value in camera.observed.items()}
    return entry
