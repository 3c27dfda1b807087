"""`jaxbundle pushbroom project`: from the ground to the image."""

from pathlib import Path
from typing import Annotated

import typer

from jaxbundle.cli.pushbroom.app import Csv, ImageFile, Json, pushbroom


@pushbroom.command(example="out/flight/scanner.toml --points out/points.csv")
def project(
    scanner: ImageFile,
    points: Annotated[
        Path, typer.Option(help="table X,Y,Z[,id] (m) or longitude,latitude,height[,id] (degrees)")
    ],
    csv: Csv = None,
    json: Json = "",
) -> None:
    """Project ground points into the image: a row for every line that sees one."""
    from jaxbundle import pushbroom as line_scanners
    from jaxbundle.cli.pushbroom.shared import check_outputs, warn, write_rows

    check_outputs([scanner, points], csv=csv, json=json)
    projected = line_scanners.project(scanner, points, tell=warn)
    write_rows(projected.columns, csv, json, projected.figures)
