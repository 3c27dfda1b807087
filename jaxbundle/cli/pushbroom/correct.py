"""`jaxbundle pushbroom correct`: rectify an image to a map."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, cast

import typer

from jaxbundle.choices import RESAMPLINGS, Resampling
from jaxbundle.cli.app import Quiet, choice
from jaxbundle.cli.pushbroom.app import Dem, Geoid, Level, ScannerFile, pushbroom
from jaxbundle.errors import InputError

if TYPE_CHECKING:
    from jaxbundle.io.scanner.scanner import ScannerInput
    from jaxbundle.pushbroom.image import PushbroomImage


@pushbroom.command(example="out/flight/scanner.toml out/flight/image.tif --out out/map.tif")
def correct(  # noqa: PLR0913 - the options of the command
    scanner: ScannerFile,
    image: Annotated[Path, typer.Argument(help="the image: a raster of all lines and pixels")],
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
    from jaxbundle.cli.progress import counting
    from jaxbundle.cli.pushbroom.shared import keep_inputs, open_scanner, surface_of
    from jaxbundle.io.rasters.correction import map_of, write_corrected
    from jaxbundle.io.rasters.error_maps import write_error_map
    from jaxbundle.io.rasters.maps import MapSystem
    from jaxbundle.pushbroom.project import make_search

    keep_inputs([scanner, image, dem, truth], out=out, error_map=error_map)
    kind = cast(Resampling, resampling)
    if spacing is not None and not spacing > 0:
        raise InputError(f"--spacing {spacing:g}: a positive number is expected")
    if (truth is None) != (error_map is None):
        raise InputError("--truth and --error-map: give both, or none")
    _check_target("--out", out, image)
    if error_map is not None:
        _check_target("--error-map", error_map, image)
        if error_map.absolute() == out.absolute():
            raise InputError(f"--error-map {error_map} is also --out; give another name")
    # an ellipsoid hides nothing of itself where an image looks down
    if occlusion and dem is None:
        raise InputError("--occlusion: needs terrain; give --dem")
    file = open_scanner(scanner)
    surface = surface_of(file.earth, height, dem, file.image, geoid)
    system = MapSystem(file.earth, crs)
    grid = map_of(file.image, surface, system, spacing, dem)
    search = make_search(file.image, file.earth)
    if truth is not None:
        true = _truth(truth, file)
    with counting(quiet) as bar:
        task = bar.add_task("blocks", total=None)
        write_corrected(
            image,
            out,
            file.image,
            search,
            surface,
            system,
            grid,
            kind,
            lambda _, done, total: bar.update(task, completed=done, total=total),
            occlusion,
        )
        if truth is not None and error_map is not None:
            task = bar.add_task("errors", total=None)
            rms = write_error_map(
                error_map,
                file.image,
                search,
                true,
                make_search(true, file.earth),
                surface,
                system,
                grid,
                lambda _, done, total: bar.update(task, completed=done, total=total),
            )
    if not quiet:
        print(f"{out}: {grid.rows} × {grid.columns} pixels of {grid.size:g}")
        if truth is not None:
            print(f"{error_map}: RMS {rms:.6g} m against {truth}")


def _check_target(option: str, path: Path, image: Path) -> None:
    """Refuse output that cannot be written, before computing."""
    if not path.absolute().parent.is_dir():
        raise InputError(f"{option} {path}: there is no folder {path.parent}")
    if path.is_dir():
        raise InputError(
            f"{option} {path} is a folder; name a file in it, such as {path / 'map.tif'}"
        )
    if path.exists() and path.samefile(image):
        raise InputError(f"{option} {path} is the image itself; give another name")


def _truth(path: Path, file: "ScannerInput") -> "PushbroomImage":
    """The true image, which must match the scanner file."""
    from jaxbundle.cli.pushbroom.shared import open_scanner

    truth = open_scanner(path)
    if truth.earth != file.earth:
        raise InputError(f"--truth {path}: its earth is not that of the scanner file")
    size, own = ((i.lines, i.pixels) for i in (truth.image, file.image))
    if size != own:
        raise InputError(
            f"--truth {path}: {size[0]} lines of {size[1]} pixels, the scanner file has {own[0]} "
            f"of {own[1]}"
        )
    return truth.image
