"""`jaxbundle pushbroom project`: from the ground to the image."""

from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from jaxbundle.cli.pushbroom.app import (
    Csv,
    Json,
    ScannerFile,
    check_spheroid,
    geographic,
    keep_inputs,
    open_scanner,
    pushbroom,
    warn,
    write_rows,
)
from jaxbundle.errors import InputError
from jaxbundle.geometry.ellipsoid import Ellipsoid, earth_fixed
from jaxbundle.io.text.csv_tables import read_csv
from jaxbundle.network.columns import Columns, did_you_mean
from jaxbundle.pushbroom.project import Status, make_search, project_points

MOST = 4
"""So many lines that see one point are told."""
CARTESIAN, GEOGRAPHIC = ("X", "Y", "Z"), ("longitude", "latitude", "height")
TOLD = ("id", "line", "pixel", "count", "status")
"""What `locate` and `project` write beside the point: their tables are taken as they are."""


@pushbroom.command()
def project(
    scanner: ScannerFile,
    points: Annotated[
        Path, typer.Option(help="table X,Y,Z[,id] (m) or longitude,latitude,height[,id] (degrees)")
    ],
    csv: Csv = None,
    json: Json = "",
) -> None:
    """Where in the image points of the ground are: a row for every line that sees one."""
    keep_inputs([scanner, points], csv=csv, json=json)
    file = open_scanner(scanner)
    table = _with_points(read_csv(points))
    X = _points(table, file.earth)
    found = project_points(file.image, make_search(file.image, file.earth), X, most=MOST)
    line, pixel = np.asarray(found.line), np.asarray(found.pixel)
    status, count = np.asarray(found.status), np.asarray(found.count)
    if (status != Status.SEEN).all():
        raise InputError(
            f"{table.source(0)}: no point is in the image; this one is "
            f"{Status(int(status[0])).meaning}: look at coordinates, frame and units"
        )
    unseen = np.flatnonzero(status != Status.SEEN)
    if len(unseen):
        first = unseen[0]
        warn(
            f"{table.source(first)}: not in the image but {Status(int(status[first])).meaning} "
            f"({len(unseen)} of {len(status)} points)"
        )
    solution, point = np.nonzero(~np.isnan(line) | ((np.arange(MOST) == 0)[:, None] & (count == 0)))
    order = np.lexsort((solution, point))
    solution, point = solution[order], point[order]
    ids = table.ids("id") if "id" in table.values else [str(k + 1) for k in range(len(status))]
    write_rows({
        "id": [ids[p] for p in point], "line": line[solution, point],
        "pixel": pixel[solution, point], "count": count[point],
        "status": [Status(int(status[p])).meaning for p in point],
    }, csv, json, {"scanner": file.name})  # fmt: skip


def _with_points(table: Columns) -> Columns:
    """The rows that have a point: `locate` leaves those without one empty, and says why."""
    if "status" not in table.values:
        return table
    given = [name for name in (*CARTESIAN, *GEOGRAPHIC) if name in table.values]
    empty = np.all([np.isnan(table.numbers(name)) for name in given], axis=0)
    if not np.any(empty):
        return table
    warn(f"{table.source(int(empty.argmax()))}: no point ({empty.sum()} rows are left out)")
    kept = np.flatnonzero(~empty).tolist()
    values = {name: [column[row] for row in kept] for name, column in table.values.items()}
    return Columns(values, table.source.take(kept))


def _points(table: Columns, earth: Ellipsoid | None) -> np.ndarray:
    """Points of a table, Earth-fixed or local; X, Y, Z where it has both."""
    cartesian = "X" in table.values
    if not cartesian and not any(name in table.values for name in GEOGRAPHIC[:2]):
        expected = (*CARTESIAN, *GEOGRAPHIC)
        odd = next((name for name in table.values if name not in TOLD), "")
        raise InputError(
            f"{table.source.name}: no columns {', '.join(CARTESIAN)} nor {', '.join(GEOGRAPHIC)}"
            f"{did_you_mean(odd, expected, listing=False)}"
        )
    if cartesian:
        table.check_names(CARTESIAN, (*GEOGRAPHIC, *TOLD))
        return np.stack([table.numbers(n, required=True) for n in CARTESIAN])
    if earth is None:
        raise InputError(f"{table.source.name}: a local frame has no longitudes; give X, Y, Z")
    check_spheroid(earth)
    table.check_names(GEOGRAPHIC, TOLD)
    return np.array(earth_fixed(earth, geographic(table)))
