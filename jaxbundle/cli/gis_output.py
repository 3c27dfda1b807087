"""The options `jaxbundle adjust --gis FILE --crs EPSG:NUMBER`."""

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
    str, typer.Option(metavar="EPSG:NUMBER", help="system of the object coordinates, for --gis")
]
SUFFIXES = (".gpkg", ".geojson", ".json")


def check_gis(gis: str, crs: str, inputs: Iterable[str | Path], force: bool = False) -> None:
    """Refuse a file or a system that cannot be written, before the work.

    **Raises:** `InputError`."""
    from jaxbundle.cli.outputs import FORCE_ADVICE, check_file, check_json
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
        require_transformation(crs)
        check_json(gis, FORCE_ADVICE, "--gis")
    elif Path(gis).is_file() and not force:
        with Path(gis).open("rb") as file:
            head = file.read(16)
        if head and not head.startswith(b"SQLite format 3"):
            raise InputError(f"--gis {gis}: exists and is no GeoPackage; give another name")


def write_gis(result: "Adjustment", gis: str, crs: str) -> None:
    """Write the file of --gis, if one was asked for."""
    from jaxbundle.io.results.gis import write_geojson, write_geopackage

    if gis and result.converged:
        write = write_geopackage if gis.lower().endswith(".gpkg") else write_geojson
        write(result, gis, crs)
