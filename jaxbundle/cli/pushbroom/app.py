"""The sub-application of line scanners, and the options its commands share."""

from pathlib import Path
from typing import Annotated

import typer

from jaxbundle.cli.app import Application, app

pushbroom = Application(
    help="Line scanners: image to ground and back, simulation, correction, accuracy.",
)
app.add_typer(pushbroom, name="pushbroom")

ScannerFile = Annotated[
    Path, typer.Argument(help="scanner file .toml, or of a product (docs/pushbroom.md)")
]
Level = Annotated[
    float | None, typer.Option("--height", help="metres above the ellipsoid; Z in a local frame")
]
Dem = Annotated[Path | None, typer.Option(help="raster of the terrain, heights as --height")]
Geoid = Annotated[
    Path | None,
    typer.Option(help="grid of the geoid above the ellipsoid, for a --dem of orthometric heights: "
                 "a raster, or the name of one of PROJ's grids"),
]  # fmt: skip
Csv = Annotated[Path | None, typer.Option(help="file for the table; - or none: standard output")]
Json = Annotated[str, typer.Option(help="the table as JSON instead; - for standard output")]
