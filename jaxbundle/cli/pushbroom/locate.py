"""`jaxbundle pushbroom locate`: from the image to the ground."""

import dataclasses
from pathlib import Path
from typing import Annotated

import jax
import numpy as np
import typer

from jaxbundle.cli.pushbroom.app import (
    Csv,
    Dem,
    Geoid,
    Json,
    Level,
    ScannerFile,
    keep_inputs,
    open_scanner,
    pushbroom,
    surface_of,
    warn,
    write_rows,
)
from jaxbundle.errors import InputError
from jaxbundle.geometry.ellipsoid import geodetic
from jaxbundle.io.text.csv_tables import read_csv
from jaxbundle.network.tables import Source
from jaxbundle.pushbroom.image import PushbroomImage
from jaxbundle.pushbroom.locate import locate_points
from jaxbundle.pushbroom.terrain import Terrain

OFF = "off the image"
OVER = "found beyond a place without height"
TOLD = ("id", "X", "Y", "Z", "longitude", "latitude", "height", "count", "status")
"""What `locate` and `project` write beside line and pixel: their tables are taken as they are."""


@pushbroom.command()
def locate(
    scanner: ScannerFile,
    points: Annotated[Path | None, typer.Option(help="table line,pixel[,id]")] = None,
    grid: Annotated[
        str, typer.Option(help="LINESxPIXELS places over the whole image, if no points")
    ] = "11x11",
    height: Level = None,
    dem: Dem = None,
    geoid: Geoid = None,
    csv: Csv = None,
    json: Json = "",
) -> None:
    """Where on the ground places of the image are; (0, 0) is the centre of the first pixel."""
    keep_inputs([scanner, points, dem, geoid], csv=csv, json=json)
    file = open_scanner(scanner)
    surface = surface_of(file.earth, height, dem, file.image, geoid)
    ids, line, pixel, source = places(file.image, points, grid)
    off = _off(file.image, line, pixel, source)
    find = jax.jit(locate_points)
    X = np.array(find(file.image, surface, line, pixel))
    X[:, off] = np.nan
    missed = np.isnan(X).any(0) & ~off
    over = np.zeros_like(missed)
    if isinstance(surface, Terrain):
        strict = dataclasses.replace(surface, over_voids=False)
        over = ~(missed | off) & np.isnan(np.array(find(file.image, strict, line, pixel))).any(0)
    reason = "no terrain there" if dem else "misses the surface"
    if missed.any():
        row = int(missed.argmax())
        remedy = (
            f"give a model that covers the image instead of {dem}" if dem
            else "look at attitude, mounting and height"
        )
        said = (
            f"{source(row)}: the ray of line {line[row]:g}, pixel {pixel[row]:g}: {reason}; "
            f"{remedy} ({missed.sum()} of {len(line)} points)"
        )
        if (missed | off).all():
            raise InputError(said)
        warn(said)
    columns = {"id": ids} if ids else {}
    columns |= {"line": line, "pixel": pixel, "X": X[0], "Y": X[1], "Z": X[2]}
    if file.earth is not None and file.earth.a == file.earth.b:
        longitude, latitude, h = (np.asarray(v) for v in jax.jit(geodetic)(file.earth, tuple(X)))
        columns |= {"longitude": np.degrees(longitude), "latitude": np.degrees(latitude)}
        columns |= {"height": h}
    columns["status"] = np.select([off, missed, over], [OFF, reason, OVER], "found").tolist()
    write_rows(columns, csv, json, {"scanner": file.name})


def places(image: PushbroomImage, points: Path | None, grid: str):
    """Ids, lines, pixels and their source: of a table, or a grid over the image."""
    if points is None:
        try:
            rows, columns = (int(n) for n in grid.lower().split("x"))
            if min(rows, columns) < 1:
                raise ValueError
        except ValueError:
            raise InputError(f"--grid {grid!r}: two numbers are expected, such as 11x11") from None
        lines = np.repeat(np.linspace(0, image.lines - 1, rows), columns)
        pixels = np.tile(np.linspace(0, image.pixels - 1, columns), rows)
        return (), lines, pixels, Source("grid", None, "place")
    table = read_csv(points)
    table.check_names(("line", "pixel"), TOLD)
    line, pixel = (table.numbers(name, required=True) for name in ("line", "pixel"))
    ids = table.ids("id") if "id" in table.values else ()
    return ids, line, pixel, table.source


def _off(image: PushbroomImage, line: np.ndarray, pixel: np.ndarray, source: Source) -> np.ndarray:
    """Which places are off the image; told, and refused if all are."""
    off = np.zeros(len(line), bool)
    said = None
    for name, values, size in (("line", line, image.lines), ("pixel", pixel, image.pixels)):
        outside = ~((values >= -0.5) & (values <= size - 0.5))
        if outside.any() and said is None:
            row = int(outside.argmax())
            said = (
                f"{source(row)}: {name} {values[row]:g} is {OFF}, which has {size}; -0.5 to "
                f"{size - 0.5:g} is expected"
            )
        off |= outside
    if said is not None:
        said += f" ({off.sum()} of {len(off)} points)"
        if off.all():
            raise InputError(said)
        warn(said)
    return off
