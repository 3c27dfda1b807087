"""`jaxbundle pushbroom locate`: from the image to the ground."""

from pathlib import Path
from typing import Annotated

import typer

from jaxbundle.cli.pushbroom.app import Csv, Dem, Geoid, ImageFile, Json, Level, pushbroom


@pushbroom.command(example="out/flight/scanner.toml --grid 3x3 --csv out/points.csv")
def locate(
    scanner: ImageFile,
    points: Annotated[Path | None, typer.Option(help="table line,pixel[,id]")] = None,
    grid: Annotated[
        str, typer.Option(help="LINESxPIXELS positions over the image, without --points")
    ] = "11x11",
    height: Level = None,
    dem: Dem = None,
    geoid: Geoid = None,
    csv: Csv = None,
    json: Json = "",
) -> None:
    """Locate image positions on the ground; (0, 0) is the centre of the first pixel."""
    from jaxbundle import pushbroom as line_scanners
    from jaxbundle.cli.pushbroom.places import grid_of
    from jaxbundle.cli.pushbroom.shared import check_outputs, warn, write_rows

    check_outputs([scanner, points, dem, geoid], csv=csv, json=json)
    located = line_scanners.locate(
        scanner,
        points=points,
        grid=grid_of(grid),
        height=height,
        dem=dem,
        geoid=geoid,
        tell=warn,
    )
    write_rows(located.columns, csv, json, located.figures)
