"""Control points with their measurements in photographs.

| file | rows |
|---|---|
| `gcp_list.txt` of OpenDroneMap | first the coordinate system; then X Y Z u v photograph [name] |
| table with header | `id`, `X`, `Y`, `Z`, `image`, `u`, `v` [, `sX`, `sY`, `sZ`, `role`, `suv`] |
| table without measurements | as `jaxbundle adjust --control`: of coded targets, by their names |

u, v are pixels, (0, 0) the centre of the upper left one. Coordinates in degrees are converted to
their UTM zone.
"""

import csv
import dataclasses
import itertools
import math
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float

from jaxbundle.errors import InputError
from jaxbundle.io.networks.control import read_control
from jaxbundle.io.text.csv_tables import read_text
from jaxbundle.network.columns import count, list_some
from jaxbundle.network.rules import check_choice
from jaxbundle.network.tables import ROLES, Points, Source
from jaxbundle.photographs.places import to_map
from jaxbundle.system.foreign_parsers import foreign_parser

# Default σ of a manual measurement, pixels: a person hits a mark to about that. If the rays of the
# points meet worse, σ are multiplied by the robust scale (`OrientedBlock.resolve`), so a smaller
# value corrects itself, a larger one stays.
MANUAL_SIGMA = 1.0


@dataclasses.dataclass(frozen=True)
class Control:
    """Control points, and their image points: rows of (photograph, point); `system`: its
    name; `notes`: what was assumed in reading."""

    points: Points
    sightings: tuple[tuple[str, str], ...]
    xy: Float[np.ndarray, "n 2"]
    sigma: Float[np.ndarray, " n"]
    system: str = ""
    notes: tuple[str, ...] = ()


def with_sigma(control: Control, text: str) -> Control:
    """Control with a σ where none is given: `SIGMA`, or `SIGMA,HEIGHT`, metres.

    **Raises:** `InputError`."""
    try:
        values = [float(part) for part in text.split(",")]
    except ValueError:
        values = []
    if len(values) not in (1, 2) or not all(0 < v < math.inf for v in values):
        raise InputError(
            f"--control-sigma {text}: expected a positive number of metres, or two with a comma "
            "(plane and height)"
        )
    sigma = np.array([values[0], values[0], values[-1]])
    points, free = control.points, np.array(control.points.role, object) != "fixed"
    completed = np.where(np.isnan(points.sigma) & free[:, None], sigma, points.sigma)
    return dataclasses.replace(control, points=dataclasses.replace(points, sigma=completed))


def read_control_measurements(path: str | Path) -> Control:
    """Control points, with measurements if the file has them.

    **Raises:** `InputError` naming file and line.
    """
    path = Path(path)
    lines = read_text(path).splitlines()
    rows = [
        (n, line)
        for n, line in enumerate(lines, 1)
        if line.strip() and not line.lstrip().startswith("#")
    ]
    if not rows:
        raise InputError(f"{path}: the file is empty")
    # Three formats, told apart by the first line: column names, a coordinate system, anything else.
    for separator in SEPARATORS:
        head = [cell.strip().lower() for cell in rows[0][1].split(separator)]
        if "image" in head:
            if missing := [name for name in COLUMNS if name not in head]:
                raise InputError(
                    f"{path}, line {rows[0][0]}: a table of measurements has the columns "
                    f"{', '.join(COLUMNS)}; missing: {', '.join(missing)}"
                )
            return _read_table(path, head, rows[1:], separator)
    first_line = rows[0][1].strip()
    if first_line.upper().startswith(("EPSG:", "WGS84", "+PROJ", "PROJCS", "GEOGCS")):
        return _read_gcp_list(path, first_line, rows[1:])
    if _is_sighting(_cells(rows[0][1])):
        raise InputError(
            f"{path}, line {rows[0][0]}: the first line of a list X Y Z u v photograph [name] "
            "names its coordinate system, such as EPSG:32611"
        )
    points = read_control(path)
    return Control(points, (), np.zeros((0, 2)), np.zeros(0))


# Of a table of measurements, at least.
COLUMNS = ("id", "x", "y", "z", "image", "u", "v")
# Between the cells of a table.
SEPARATORS = (",", ";", "\t")

# Point, its coordinates, photograph, pixels, their σ, and the line of the file.
Record = tuple[str, tuple[float, float, float], str, tuple[float, float], float, int]


def _read_gcp_list(path: Path, system: str, rows: Sequence[tuple[int, str]]) -> Control:
    records: list[Record] = []
    # Rows without a name are of one point if their coordinates are equal, as text: the height tells
    # apart points above each other on a façade. Names that others have are passed over.
    taken = {cells[6] for _, line in rows if len(cells := _cells(line)) > 6}
    numbered: dict[tuple[str, ...], str] = {}
    numbered_names = (name for k in itertools.count(1) if (name := f"gcp{k}") not in taken)
    for number, line in rows:
        cells = _cells(line)
        if not _is_sighting(cells):
            raise InputError(
                f"{path}, line {number}: expected X Y Z u v photograph [name], separated by blanks "
                f"or tabs, with decimal points, got {line!r}"
            )
        X, Y, Z, u, v = (float(cell) for cell in cells[:5])
        image = cells[5]
        if "." not in image:
            raise InputError(
                f"{path}, line {number}: photograph {image!r} has no ending, such as .jpg; a name "
                "with blanks needs tabs between the columns"
            )
        name = "".join(cells[6:7])
        if not name:
            place = tuple(cells[:3])
            name = numbered[place] if place in numbered else next(numbered_names)
            numbered[place] = name
        records.append((name, (X, Y, Z), image, (u, v), MANUAL_SIGMA, number))
    control = _collect(path, records, system, {})
    if not numbered:
        return control
    names = list_some(numbered.values(), as_text=str)
    have = f"{count(len(numbered), 'point')} without a name, numbered in the order of the list"
    return dataclasses.replace(control, notes=(f"{path.name}: {have}: {names}",))


def _cells(line: str) -> list[str]:
    """The cells of a list, by tabs if there are enough, else by blanks."""
    by_tabs = [cell.strip() for cell in line.split("\t")]
    return by_tabs if len(by_tabs) >= 6 else line.split()


def _is_sighting(cells: Sequence[str]) -> bool:
    """Whether cells are five numbers and a photograph, which is none: id, X, Y, Z and their σ, in a
    table without a header, are numbers, too."""
    return [_is_number(cell) for cell in cells[:6]] == [True] * 5 + [False]


def _is_number(cell: str) -> bool:
    try:
        float(cell)
    except ValueError:
        return False
    return True


def _read_table(
    path: Path, head: Sequence[str], rows: Sequence[tuple[int, str]], separator: str
) -> Control:
    records, sigmas = [], {}
    for number, line in rows:
        with foreign_parser(f"{path}, line {number}", "a row of a CSV table"):
            (row,) = csv.reader([line], delimiter=separator, skipinitialspace=True)
        if len(row) != len(head):
            raise InputError(
                f"{path}, line {number}: {len(row)} cells where the header has {len(head)} "
                f"({', '.join(head)}); decimals need a point, empty cells their comma"
            )
        cells = dict(zip(head, row))

        def value(
            name: str,
            otherwise: float = math.nan,
            cells: dict[str, str] = cells,
            number: int = number,
        ) -> float:
            text = (cells.get(name) or "").strip()
            # Where commas do not separate, they are decimal ones.
            text = text if separator == "," else text.replace(",", ".")
            try:
                return float(text) if text else otherwise
            except ValueError:
                raise InputError(
                    f"{path}, line {number}: {name} is {text!r}; expected a number"
                ) from None

        id, role = cells["id"].strip(), (cells.get("role") or "").strip()
        if not id:
            raise InputError(f"{path}, line {number}: the id is empty; expected that of a point")
        if role:
            check_choice("role", role, ROLES, f"{path}, line {number}: ")
        stated = [value(f"s{axis}") for axis in "xyz"]
        if any(s <= 0 for s in stated):
            raise InputError(f"{path}, line {number}: sX, sY, sZ must be positive, or empty")
        above, role_above = sigmas.get(id, (stated, role))
        is_other_role = role and role_above and role != role_above
        if is_other_role or any(a != s for a, s in zip(above, stated) if a > 0 and s > 0):
            raise InputError(f"{path}, line {number}: point {id} has another σ or role above")
        # One row of a point may state its σ and its role for all.
        sigmas[id] = [s if s > 0 else a for a, s in zip(above, stated)], role or role_above
        X, uv = tuple(value(axis) for axis in "xyz"), (value("u"), value("v"))
        image, sigma = cells["image"].strip(), value("suv", MANUAL_SIGMA)
        records.append((id, X, image, uv, sigma, number))
    return _collect(path, records, "", sigmas)


def _collect(
    path: Path,
    records: Sequence[Record],
    system: str,
    sigmas: Mapping[str, tuple[Sequence[float], str]],
) -> Control:
    """The control of a file; `sigmas`: σ and role by point, where the file states them."""
    if not records:
        raise InputError(f"{path}: contains no control points")
    position, numbers, measured = {}, {}, {}
    for name, X, image, place, sigma, number in records:
        if not np.isfinite([*X, *place]).all():
            raise InputError(f"{path}, line {number}: coordinates and pixels must be finite")
        if not 0 < sigma < math.inf:
            raise InputError(f"{path}, line {number}: suv must be positive, or empty")
        above = measured.setdefault((image, name), number)
        if above != number:
            raise InputError(
                f"{path}, line {number}: point {name} is measured in {image} in line {above}, too; "
                "leave one of the two"
            )
        # The table repeats the coordinates in each row of a point.
        if name in position and position[name] != X:
            raise InputError(f"{path}, line {number}: point {name} has other coordinates above")
        position[name] = X
        numbers.setdefault(name, number)
    X, system_words = to_map(np.array(list(position.values())), system, str(path))
    # Control without a σ, NaN, gets one from --control-sigma or from its residuals.
    sigma = np.array([sigmas.get(n, ([math.nan] * 3, ""))[0] for n in position])
    roles = tuple(sigmas.get(n, ((), ""))[1] or "control" for n in position)
    source = Source(str(path), np.array(list(numbers.values())), "line")
    return Control(
        Points(tuple(position), roles, X, sigma, source),
        tuple((image, name) for name, _, image, *_ in records),
        np.array([place for *_, place, _, _ in records]),
        np.array([sigma for *_, sigma, _ in records]),
        system_words,
    )
