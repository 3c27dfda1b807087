"""`jaxbundle pushbroom correct`: rectify an image to a map."""

from pathlib import Path
from typing import Annotated

import typer

from jaxbundle.choices import RESAMPLINGS
from jaxbundle.cli.app import Quiet, choice
from jaxbundle.cli.pushbroom.app import Dem, Geoid, ImageFile, Level, pushbroom


@pushbroom.command(example="out/flight/scanner.toml out/flight/image.tif --out out/map.tif")
def correct(  # noqa: PLR0913 - the options of the command
    scanner: ImageFile,
    image: Annotated[
        Path | None,
        typer.Argument(
            help="the image: a raster of all lines and pixels; omit it if SCANNER is it"
        ),
    ] = None,
    *,
    out: Annotated[Path, typer.Option(help="GeoTIFF to write")],
    crs: Annotated[
        str | None, typer.Option(help="EPSG:… of the map; default: longitude, latitude")
    ] = None,
    spacing: Annotated[
        float | None,
        typer.Option(help="pixel size of the map, in its unit; default: that of the image"),
    ] = None,
    height: Level = None,
    dem: Dem = None,
    geoid: Geoid = None,
    resampling: Annotated[str, choice(RESAMPLINGS)] = "bilinear",
    occlusion: Annotated[
        bool, typer.Option("--occlusion", help="no data where terrain of --dem hides the ground")
    ] = False,
    truth: Annotated[
        Path | None, typer.Option(help="scanner file of the truth, for --error-map")
    ] = None,
    error_map: Annotated[
        Path | None, typer.Option(help="GeoTIFF of the map errors: east, north, length")
    ] = None,
    quiet: Quiet = False,
) -> None:
    """Correct an image to a map, in blocks."""
    from jaxbundle import pushbroom as line_scanners
    from jaxbundle.cli.progress import staging
    from jaxbundle.cli.pushbroom.shared import keep_inputs, warn

    keep_inputs([scanner, image, dem, truth], out=out, error_map=error_map)
    with staging(quiet) as show:
        found = line_scanners.correct(
            scanner,
            image,
            out,
            crs=crs,
            spacing=spacing,
            height=height,
            dem=dem,
            geoid=geoid,
            resampling=resampling,
            occlusion=occlusion,
            truth=truth,
            error_map=error_map,
            progress=show,
            tell=warn,
        )
    if not quiet:
        print(f"{found}{'' if truth is None else f' against {truth}'}")
