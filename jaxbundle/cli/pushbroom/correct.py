"""`jaxbundle pushbroom correct`: rectify an image to a map."""

from pathlib import Path
from typing import Annotated

import typer

from jaxbundle.choices import COMPRESSIONS, MAP_ERRORS, RESAMPLINGS
from jaxbundle.cli.app import Quiet, choice
from jaxbundle.cli.pushbroom.app import Dem, Geoid, ImageFile, Level, pushbroom
from jaxbundle.errors import InputError
from jaxbundle.system.interrupts import advise


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
    tolerance: Annotated[
        float,
        typer.Option(
            min=0, help="of interpolated image positions, pixels; 0: project every pixel of the map"
        ),
    ] = 0.02,
    nodata: Annotated[
        float | None, typer.Option(help="no-data value; default: of the image, else 0 or NaN")
    ] = None,
    compress: Annotated[
        str | None, choice(COMPRESSIONS, "default: none, deflate with --cog")
    ] = None,
    overviews: Annotated[
        bool, typer.Option("--overviews", help="add overviews to the map")
    ] = False,
    cog: Annotated[
        bool, typer.Option("--cog", help="write a Cloud Optimized GeoTIFF, with overviews")
    ] = False,
    checkpoint: Annotated[
        Path | None,
        typer.Option(help="file of finished blocks: an interrupted run resumes from it"),
    ] = None,
    sigma: Annotated[
        Path | None, typer.Option(help="GeoTIFF of the planimetric σ of the map, from --error")
    ] = None,
    error: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME=SIGMA",
            help=f"σ for --sigma, may be repeated: {', '.join(MAP_ERRORS)} (degrees, metres, per "
            "second, pixels); default with RPC: ground, as its file states",
        ),
    ] = None,
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
    from jaxbundle.cli.pushbroom.shared import check_outputs, warn

    outputs = {"out": out, "error_map": error_map, "sigma": sigma, "checkpoint": checkpoint}
    check_outputs([scanner, image, dem, geoid, truth], **outputs)
    errors = _errors(error or [])
    if checkpoint is not None:
        advise(f"run the same command again to resume; finished blocks are kept in {checkpoint}")
    with staging(quiet) as show:
        result = line_scanners.correct(
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
            tolerance=tolerance,
            nodata=nodata,
            compress=compress,
            overviews=overviews,
            cog=cog,
            checkpoint=checkpoint,
            sigma=sigma,
            errors=errors,
            truth=truth,
            error_map=error_map,
            progress=show,
            tell=warn,
        )
    if not quiet:
        print(f"{result}{'' if truth is None else f' against {truth}'}")


def _errors(assignments: list[str]) -> dict[str, float]:
    """σ by name."""
    errors = {}
    for text in assignments:
        name, _, value = text.partition("=")
        try:
            errors[name] = float(value)
        except ValueError:
            raise InputError(
                f"--error {text}: expected NAME=SIGMA, such as {MAP_ERRORS[0]}=0.001"
            ) from None
    return errors
