"""`jaxbundle pushbroom project`: from the ground to the image."""

from pathlib import Path
from typing import Annotated

import typer

from jaxbundle.cli.pushbroom.app import Csv, Json, ScannerFile, pushbroom
from jaxbundle.errors import InputError


@pushbroom.command(example="out/flight/scanner.toml --points out/points.csv")
def project(
    scanner: ScannerFile,
    points: Annotated[
        Path, typer.Option(help="table X,Y,Z[,id] (m) or longitude,latitude,height[,id] (degrees)")
    ],
    csv: Csv = None,
    json: Json = "",
) -> None:
    """Project ground points into the image: a row for every line that sees one."""
    import numpy as np

    from jaxbundle.cli.pushbroom.ground_points import points_of, with_points
    from jaxbundle.cli.pushbroom.shared import keep_inputs, open_scanner, warn, write_rows
    from jaxbundle.io.text.csv_tables import read_csv
    from jaxbundle.pushbroom.project import ProjectionStatus, make_search, project_points

    keep_inputs([scanner, points], csv=csv, json=json)
    file = open_scanner(scanner)
    table = with_points(read_csv(points))
    X = points_of(table, file.earth)
    # where lines overlap, as of a platform that sways, several see one point
    most = 4
    found = project_points(file.image, make_search(file.image, file.earth), X, most=most)
    line, pixel = np.asarray(found.line), np.asarray(found.pixel)
    status, count = np.asarray(found.status), np.asarray(found.count)
    if (status != ProjectionStatus.SEEN).all():
        raise InputError(
            f"{table.source(0)}: no point is in the image; this one is "
            f"{ProjectionStatus(int(status[0])).meaning}: check coordinates, frame and units"
        )
    unseen = np.flatnonzero(status != ProjectionStatus.SEEN)
    if len(unseen):
        first = unseen[0]
        warn(
            f"{table.source(first)}: not in the image but "
            f"{ProjectionStatus(int(status[first])).meaning} "
            f"({len(unseen)} of {len(status)} points)"
        )
    first = (np.arange(most) == 0)[:, None]
    solution, point = np.nonzero(~np.isnan(line) | (first & (count == 0)))
    order = np.lexsort((solution, point))
    solution, point = solution[order], point[order]
    ids = table.ids("id") if "id" in table.values else [str(k + 1) for k in range(len(status))]
    write_rows(
        {
            "id": [ids[p] for p in point],
            "line": line[solution, point],
            "pixel": pixel[solution, point],
            "count": count[point],
            "status": [ProjectionStatus(int(status[p])).meaning for p in point],
        },
        csv,
        json,
        {"scanner": file.name},
    )
