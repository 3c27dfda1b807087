"""The options `--gis FILE --crs EPSG:NUMBER` of `adjust` and `reconstruct`."""

import re
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from jaxbundle.errors import InputError

if TYPE_CHECKING:
    from jaxbundle.adjustment.result import Adjustment

Gis = Annotated[
    str,
    typer.Option(
        metavar="FILE.gpkg|FILE.geojson",
        help="write points, stations and error ellipses for QGIS and other GIS",
    ),
]
Crs = Annotated[
    str,
    typer.Option(
        metavar="EPSG:NUMBER",
        help="system of the object coordinates, for --gis; `reconstruct` knows that of satellite "
        "positions and of control that names it",
    ),
]
SUFFIXES = (".gpkg", ".geojson", ".json")
# The beginning of a GeoPackage, a database of SQLite.
SQLITE = re.compile(rb"SQLite format 3")


def check_gis(
    gis: str,
    crs: str,
    inputs: Iterable[str | Path],
    force: bool = False,
    system_may_follow: bool = False,
) -> None:
    """Refuse a file or a system that cannot be written, before the work; `system_may_follow`: from
    the photographs or their control.

    **Raises:** `InputError`."""
    from jaxbundle.cli.outputs import FORCE_ADVICE, JSON, check_content, check_file
    from jaxbundle.io.results.gis import check_crs, require_transformation

    if not gis:
        if crs:
            raise InputError("--crs: it is for --gis; give a file there")
        return
    suffix = Path(gis).suffix.lower()
    if suffix not in SUFFIXES:
        raise InputError(f"--gis {gis}: expected a name that ends with .gpkg or .geojson")
    check_file("--gis", gis, None, inputs)
    check_crs(crs)
    if suffix != ".gpkg":
        if crs or not system_may_follow:
            require_transformation(crs)
    if not force:
        content, noun = (SQLITE, "a GeoPackage") if suffix == ".gpkg" else (JSON, "JSON")
        check_content("--gis", gis, content, noun, FORCE_ADVICE)


def write_gis(result: "Adjustment", gis: str, crs: str) -> None:
    """Write the file of --gis, if one was asked for.

    **Raises:** `InputError` for GeoJSON of a frame without a map system."""
    from jaxbundle.io.results.gis import write_geojson, write_geopackage

    if not (gis and result.converged):
        return
    if gis.lower().endswith(".gpkg"):
        write_geopackage(result, gis, crs)
    elif crs:
        write_geojson(result, gis, crs)
    else:
        raise InputError(
            f"--gis {gis}: not written, all else is: GeoJSON has longitude and latitude, and the "
            "photographs have neither positions nor control in a named system; give --crs, or "
            "the name of a GeoPackage, which keeps local coordinates"
        )
