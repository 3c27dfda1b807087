"""`jaxbundle pushbroom correct`: the image as a map."""

from pathlib import Path
from typing import Annotated

import typer

import jaxbundle
from jaxbundle.cli.app import Quiet
from jaxbundle.cli.progress import counting
from jaxbundle.cli.pushbroom.app import (
    Dem,
    Level,
    ScannerFile,
    check_resampling,
    pushbroom,
    surface_of,
)
from jaxbundle.errors import InputError
from jaxbundle.io.correction import map_of, write_corrected
from jaxbundle.io.maps import MapSystem
from jaxbundle.io.scanner import read_scanner
from jaxbundle.pushbroom.project import make_search


@pushbroom.command()
def correct(
    scanner: ScannerFile,
    image: Annotated[Path, typer.Argument(help="the image: a raster of all lines and pixels")],
    out: Annotated[Path, typer.Option(help="GeoTIFF to write")],
    crs: Annotated[str | None, typer.Option(help="EPSG:… of the map; longitude, latitude")] = None,
    spacing: Annotated[
        float | None, typer.Option(help="size of its pixels, in its unit; else the image's own")
    ] = None,
    height: Level = None,
    dem: Dem = None,
    resampling: Annotated[str, typer.Option(help="nearest, bilinear, cubic")] = "bilinear",
    occlusion: Annotated[
        bool, typer.Option("--occlusion", help="leave out what other terrain of --dem hides")
    ] = False,
    quiet: Quiet = False,
) -> None:
    """Correct an image to a map, in blocks."""
    jaxbundle.enable_x64()
    check_resampling(resampling)
    if spacing is not None and not spacing > 0:
        raise InputError(f"--spacing {spacing:g}: a positive number is expected")
    if not out.absolute().parent.is_dir():
        raise InputError(f"--out {out}: there is no folder {out.parent}")
    if out.is_dir():
        raise InputError(f"--out {out} is a folder; name a file in it, such as {out / 'map.tif'}")
    if out.exists() and out.samefile(image):
        raise InputError(f"--out {out} is the image itself; give another name")
    if occlusion and dem is None:
        raise InputError("--occlusion: only terrain hides terrain; give --dem")
    file = read_scanner(scanner)
    surface = surface_of(file.earth, height, dem, file.image)
    system = MapSystem(file.earth, crs)
    grid = map_of(file.image, surface, system, spacing, dem)
    with counting(quiet) as bar:
        task = bar.add_task("blocks", total=None)
        write_corrected(
            image, out, file.image, make_search(file.image, file.earth), surface, system, grid,
            resampling, lambda done, total: bar.update(task, completed=done, total=total),
            occlusion,
        )  # fmt: skip
    if not quiet:
        print(f"{out}: {grid.rows} × {grid.columns} pixels of {grid.size:g}")
