"""`jaxbundle pushbroom simulate`: simulate a flight, its ancillary files and its image."""

from pathlib import Path
from typing import Annotated

import typer

from jaxbundle.choices import RESAMPLINGS
from jaxbundle.cli.app import Force, Quiet, choice
from jaxbundle.cli.pushbroom.app import Dem, Geoid, Level, pushbroom


@pushbroom.command(example="examples/line_scanner/flight.toml --out out/flight")
def simulate(
    flight: Annotated[Path, typer.Argument(help="flight file, .toml (docs/pushbroom.md)")],
    out: Annotated[Path, typer.Option(help="folder for scanner.toml, tables, truth/, image.tif")],
    force: Force = False,
    scene: Annotated[Path | None, typer.Option(help="georeferenced raster to image")] = None,
    height: Level = None,
    dem: Dem = None,
    geoid: Geoid = None,
    resampling: Annotated[str, choice(RESAMPLINGS)] = "cubic",
    quiet: Quiet = False,
) -> None:
    """Simulate a flight: instrument records, the truth, and the image of a scene."""
    from jaxbundle import pushbroom as line_scanners
    from jaxbundle.cli.progress import staging

    with staging(quiet) as show:
        scanner_file = line_scanners.simulate(
            flight,
            out,
            scene=scene,
            height=height,
            dem=dem,
            geoid=geoid,
            resampling=resampling,
            force=force,
            progress=show,
        )
    if not quiet:
        print(scanner_file)
