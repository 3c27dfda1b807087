"""Shared by the line scanner commands: surfaces, scanner files, tables."""

import json
import os
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import typer

from jaxbundle.cli.outputs import check_json
from jaxbundle.errors import InputError
from jaxbundle.geometry.ellipsoid import Ellipsoid
from jaxbundle.io.rasters.extent import image_extent, rpc_extent
from jaxbundle.io.rasters.geoid import add_geoid
from jaxbundle.io.rasters.reading import read_terrain
from jaxbundle.io.results.result_json import without_nan
from jaxbundle.io.scanner.read import read_scanner
from jaxbundle.io.scanner.scanner import ScannerInput
from jaxbundle.io.text.csv_tables import write_csv, write_text
from jaxbundle.io.writing.fingerprints import files_read
from jaxbundle.network.columns import Columns
from jaxbundle.pushbroom.image import PushbroomImage
from jaxbundle.pushbroom.rpc import Rpc
from jaxbundle.pushbroom.surfaces import Ground, Height, Plane, Surface
from jaxbundle.system.terminals import write_json
from jaxbundle.types import Column


def surface_of(
    earth: Ellipsoid | None,
    height: float | None,
    dem: Path | None,
    image: PushbroomImage | Rpc | None = None,
    geoid: Path | None = None,
) -> Surface:
    """The surface selected by the options; default: the ellipsoid (or Z = 0).

    Only the visible part of a terrain model is read.
    """
    if geoid is not None and dem is None:
        raise InputError("--geoid: needs a terrain model; give --dem")
    if height is not None and not np.isfinite(height):
        raise InputError(f"--height {height}: a finite number is expected, in metres")
    if dem is not None:
        if height is not None:
            raise InputError("--height and --dem: give one of them")
        check_spheroid(earth)
        extent = None
        if isinstance(image, Rpc):
            extent = rpc_extent(image)
        elif image is not None and earth is not None:
            extent = image_extent(image, earth)
        terrain = read_terrain(dem, earth, extent)
        return terrain if geoid is None else add_geoid(terrain, geoid)
    if earth is None:
        return Plane(level=height or 0.0)
    if height is None:
        return Ground(earth)
    check_spheroid(earth)
    return Height(level=height, earth=earth)


def open_scanner(path: Path) -> ScannerInput:
    """A scanner file; its warnings go to standard error."""
    file = read_scanner(path)
    for warning in file.warnings:
        warn(warning)
    return file


def keep_inputs(inputs: Sequence[str | Path | None], **outputs: str | Path | None) -> None:
    """Refuse an output file, by option name, that is an input; for JSON, `check_json`."""
    read = {os.path.realpath(file) for path in inputs if path for file in files_read(path)}
    for option, path in outputs.items():
        if path and os.path.realpath(path) in read:
            raise InputError(
                f"--{option.replace('_', '-')} {path} is part of the input and would be "
                "overwritten; give another"
            )
    check_json(str(outputs.get("json") or ""))


def check_spheroid(earth: Ellipsoid | None) -> None:
    """Refuse heights above a triaxial ellipsoid."""
    if earth is not None and earth.a != earth.b:
        raise InputError(
            "heights, longitude and latitude need an ellipsoid of revolution; make the first two "
            "axes of [scanner] earth equal"
        )


def geographic(table: Columns) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Columns longitude, latitude (degrees), height as radians and metres.

    **Raises:** `InputError` with the row of an angle out of range.
    """
    names = "longitude", "latitude", "height"
    longitude, latitude, height = (table.numbers(name, required=True) for name in names)
    for name, values, most in ((names[0], longitude, 360), (names[1], latitude, 90)):
        if (beyond := ~(np.abs(values) <= most)).any():
            row = int(beyond.argmax())
            raise InputError(
                f"{table.source(row)}: {name} {values[row]:g} is beyond {most}°; degrees are "
                "expected; check the order of columns"
            )
    return np.radians(longitude), np.radians(latitude), height


def write_rows(
    columns: Mapping[str, Column], csv: Path | None, json_: str, head: Mapping | None = None
) -> None:
    """A table as CSV or JSON, in a file or on standard output."""
    columns = {
        name: values.tolist() if isinstance(values, np.ndarray) else list(values)
        for name, values in columns.items()
    }
    rows = list(zip(*columns.values()))
    if json_:
        rows = [dict(zip(columns, row)) for row in rows]
        text = json.dumps(without_nan({**(head or {}), "rows": rows}), ensure_ascii=False) + "\n"
        if json_ == "-":
            write_json(text)
        else:
            write_text(Path(json_), text)
    # NaN, which is not equal to itself, is an empty cell
    rows = [["" if v != v else v for v in row] for row in zip(*columns.values())]
    if csv is not None and str(csv) != "-":
        write_csv(csv, list(columns), rows)
    elif not json_:
        print(",".join(columns))
        for row in rows:
            print(",".join(map(str, row)))


def warn(message: str) -> None:
    """A line on standard error."""
    typer.echo(f"jaxbundle: {message}", err=True)
