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
    Path, typer.Argument(help="scanner file .toml, or product file (docs/pushbroom.md)")
]
ImageFile = Annotated[
    Path,
    typer.Argument(
        help="scanner file .toml, product file, or an image with RPC: raster or coefficients",
    ),
]
Level = Annotated[
    float | None, typer.Option("--height", help="metres above the ellipsoid; Z in a local frame")
]
Dem = Annotated[
    Path | None,
    typer.Option(help="terrain raster, VRT, or folder of tiles, heights like --height"),
]
Geoid = Annotated[
    Path | None,
    typer.Option(
        help="geoid heights, for a --dem of orthometric heights: "
        "a raster, or the name of a PROJ grid"
    ),
]
Csv = Annotated[Path | None, typer.Option(help="file for the table; default: standard output")]
Json = Annotated[str, typer.Option(help="the table as JSON; - for standard output")]
