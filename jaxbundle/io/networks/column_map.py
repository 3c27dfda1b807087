"""Tables of other programs, read through a map of their columns: a TOML file beside them.

```toml
[project]                           # as in a project file, without the names of tables
angle_unit = "gon"
image_unit = "mm"

[[camera]]                          # as in a project file
id = "cam"
model = "brown-projected"
c = 28.8

[table.points]
file = "object.obc"                 # relative to this file
columns = ["id", "X", "Y", "Z", "-", "sX", "sY", "sZ"]

[table.images]
file = "exterior.eor"
columns = ["id", "X0", "Y0", "Z0", "omega", "phi", "kappa"]
constant = { camera = "cam" }

[table.observations]
file = "image.phc"
columns = ["image", "point", "x", "y", "..."]
scale = { x = 0.001, y = -0.001 }
```

| key of a table | meaning | if absent |
|---|---|---|
| `file` | the text file | needed |
| `columns` | names of the columns in their order (`jaxbundle.network.build`); `-`: not used; `...` as the last: whatever follows | needed |
| `separator` | `blanks`, `tab`, or one character such as `,` or `;` | `blanks` |
| `decimal` | `.` or `,` | `.` |
| `comment` | lines that begin so are skipped | none |
| `skip` | lines at the beginning that are skipped | 0 |
| `scale` | factors of columns: units, or −1 for an axis that points the other way | 1 |
| `constant` | columns that are not in the file and have one value | none |
| `rotation` | of `images`: `omega-phi-kappa`, M = R3(κ)·R2(φ)·R1(ω); `phi-omega-kappa`, M = R3(κ)·R1(ω)·R2(φ), with the columns phi, omega, kappa; `azimuth-tilt-swing`; `matrix` with m11 … m33, object → camera | `omega-phi-kappa` |

A table `distances` is optional. Without a column `role` points are tie points.
"""  # noqa: E501

import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np

from jaxbundle import geometry
from jaxbundle.arguments import show
from jaxbundle.cameras import CameraModel
from jaxbundle.errors import InputError
from jaxbundle.io.networks.poses import angles_of, apply_in_batches, are_rotations
from jaxbundle.io.networks.settings import SETTINGS, TABLES, apply_overrides, network_of
from jaxbundle.io.text.csv_tables import read_toml
from jaxbundle.io.text.rows import TextRows
from jaxbundle.network.columns import Columns, did_you_mean, refuse_unknown
from jaxbundle.network.tables import Network, Source
from jaxbundle.network.units import ANGLE_UNITS
from jaxbundle.system.file_content import read_content

KEYS = (
    "file",
    "columns",
    "separator",
    "decimal",
    "comment",
    "skip",
    "scale",
    "constant",
    "rotation",
)
SEPARATORS = {"blanks": None, "tab": "\t"}
UNUSED_COLUMN, ANY_FURTHER = "-", "..."
IDS = ("id", "camera", "role", "image", "point", "from", "to")
MATRIX = tuple(f"m{i}{k}" for i in "123" for k in "123")
ROTATIONS: dict[str, tuple[tuple[str, ...], Callable | None]] = {
    "omega-phi-kappa": (("omega", "phi", "kappa"), None),
    "phi-omega-kappa": (("phi", "omega", "kappa"), geometry.matrix_from_phi_omega_kappa),
    "azimuth-tilt-swing": (("azimuth", "tilt", "swing"), geometry.matrix_from_azimuth_tilt_swing),
    "matrix": (MATRIX, None),
}


def is_column_map(path: Path) -> bool:
    """Whether a TOML file has a section [table.…]."""
    if path.suffix.lower() != ".toml" or not path.is_file():
        return False
    return re.search(rb"^\s*\[\s*table\s*\.", read_content(path), re.M) is not None


def read_column_map(
    path: str | Path, overrides: Sequence[str] = (), models: Sequence[CameraModel] = ()
) -> Network:
    """The network of the tables a map names; `models`: own camera models it may name.

    **Raises:** `InputError` naming file, line and column.
    """
    path = Path(path)
    document = read_toml(path)
    for key in document:
        refuse_unknown(key, ("project", "camera", "table"), f"{path}: ")
    maps, cameras = document.get("table"), document.get("camera", [])
    if not isinstance(maps, dict) or not all(isinstance(m, dict) for m in maps.values()):
        raise InputError(f"{path}: expected sections [table.images] and so on")
    if not isinstance(cameras, list) or not all(isinstance(c, dict) for c in cameras):
        raise InputError(f"{path}: write [[camera]] in double brackets, one for each camera")
    project = document.get("project", {})
    if not isinstance(project, dict):
        raise InputError(f"{path}: [project] must be a section")
    for name in maps:
        refuse_unknown(name, TABLES, f"{path}: ", "table")
    settings = apply_overrides({"project": project, "camera": cameras}, overrides, SETTINGS)
    settings["project"].setdefault("name", path.stem)
    angle_unit = settings["project"].get("angle_unit", "rad")
    tables = {}
    for name in TABLES[:3]:
        if name not in maps:
            raise InputError(f"{path}: [table.{name}] is missing")
    for name, entry in maps.items():
        where = f"{path}, [table.{name}]"
        columns = _read_table(path.parent, where, entry)
        if name == "images":
            columns = _convert_rotations(where, entry, columns, ANGLE_UNITS.get(angle_unit, 1.0))
        if name == "points" and "role" not in columns.values:
            rows = ["tie"] * len(columns)
            columns = Columns({**columns.values, "role": rows}, columns.source)
        tables[name] = columns
    return network_of(settings, tables, str(path), models)


def _read_table(folder: Path, where: str, entry: Mapping) -> Columns:
    """A table by its map; numbers scaled."""
    for key in entry:
        refuse_unknown(key, KEYS, f"{where}: ")
    file, names = entry.get("file"), entry.get("columns")
    if not isinstance(file, str):
        raise InputError(f"{where}: file is {show(file)}; expected the name of a file")
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
        raise InputError(f"{where}: columns must be a list of names")
    has_further_columns = bool(names) and names[-1] == ANY_FURTHER
    names = names[:-1] if has_further_columns else names
    column_index = {name: k for k, name in enumerate(names) if name != UNUSED_COLUMN}
    if len(column_index) + names.count(UNUSED_COLUMN) < len(names):
        raise InputError(f"{where}: a column occurs twice")
    scale, constant = (_table(where, entry, key) for key in ("scale", "constant"))
    for name, factor in scale.items():
        if name not in column_index or name in IDS:
            raise InputError(f"{where}: scale of {name!r}: no such column of numbers")
        if isinstance(factor, bool) or not isinstance(factor, int | float) or factor == 0:
            raise InputError(f"{where}: scale of {name} is {show(factor)}; expected a number")
    _check_constants(where, constant, column_index)
    skip, decimal = entry.get("skip", 0), entry.get("decimal", ".")
    if isinstance(skip, bool) or not isinstance(skip, int) or skip < 0:
        raise InputError(f"{where}: skip is {show(skip)}; expected a number of lines")
    if decimal not in (".", ","):
        raise InputError(f'{where}: decimal is {show(decimal)}; expected "." or ","')
    comment = entry.get("comment", "")
    if not isinstance(comment, str):
        raise InputError(f"{where}: comment is {show(comment)}; expected text")
    texts: dict[str, list[str]] = {name: [] for name in column_index}
    lines = []
    for row in TextRows(folder / file, comment, separator=_separator(where, entry)):
        if row.number <= skip:
            continue
        if len(row) < len(names) or (len(row) > len(names) and not has_further_columns):
            raise row.error(
                f"{len(row)} columns where {where} has {len(names)}: {', '.join(names)}"
            )
        for name, k in column_index.items():
            text = row.words[k]
            has_decimal_comma = decimal == "," and name not in IDS  # an id may have a comma
            texts[name].append(text.replace(",", ".") if has_decimal_comma else text)
        lines.append(row.number)
    source = Source(str(folder / file), np.array(lines, np.int64), "line")
    columns = Columns({**texts, **{k: [v] * len(lines) for k, v in constant.items()}}, source)
    scaled = {name: columns.numbers(name) * factor for name, factor in scale.items()}
    # A σ has no sign, even if its axis is reversed.
    scaled = {name: abs(x) if name.startswith("s") else x for name, x in scaled.items()}
    return Columns({**columns.values, **scaled}, source)


def _table(where: str, entry: Mapping, key: str) -> dict:
    value = entry.get(key, {})
    if not isinstance(value, dict):
        raise InputError(f"{where}: {key} is {show(value)}; a table such as {{ x = 1 }} expected")
    return value


def _check_constants(where: str, constant: Mapping, column_index: Mapping[str, int]) -> None:
    for name in constant:
        if name in column_index:
            raise InputError(
                f"{where}: constant {name!r} is a column of the file as well; leave one of them "
                f"out ({UNUSED_COLUMN!r} in columns: not used)"
            )


def _separator(where: str, entry: Mapping) -> str | None:
    separator = entry.get("separator", "blanks")
    if separator in SEPARATORS:
        return SEPARATORS[separator]
    if not isinstance(separator, str) or len(separator) != 1:
        raise InputError(
            f"{where}: separator is {show(separator)}; expected blanks, tab or one character"
        )
    return separator


def _convert_rotations(where: str, entry: Mapping, columns: Columns, radians: float) -> Columns:
    """The table of images with ω, φ, κ in the unit of the project."""
    kind = entry.get("rotation", "omega-phi-kappa")
    if kind not in ROTATIONS:
        raise InputError(f"{where}: unknown rotation {kind!r}{did_you_mean(str(kind), ROTATIONS)}")
    names, formula = ROTATIONS[kind]
    for name in names:
        if name not in columns.values:
            raise InputError(f"{where}: rotation {kind}: the column {name!r} is missing")
    if kind == "omega-phi-kappa":
        return columns
    numbers = np.stack([columns.numbers(name, required=True) for name in names], 1)
    if formula is None:
        M = numbers.reshape(-1, 3, 3)
        for row in np.flatnonzero(~are_rotations(M))[:1]:
            raise InputError(f"{columns.source(row)}: m11 … m33 are not a rotation matrix")
    else:
        M = apply_in_batches(formula, numbers * radians, (3,), (3, 3))
    other_columns = {name: column for name, column in columns.values.items() if name not in names}
    angles = dict(zip(("omega", "phi", "kappa"), angles_of(M).T / radians))
    return Columns({**other_columns, **angles}, columns.source)
