"""`jaxbundle pushbroom locate`: from the image to the ground."""

from pathlib import Path
from typing import Annotated

import typer

from jaxbundle.cli.pushbroom.app import Csv, Dem, Geoid, Json, Level, ScannerFile, pushbroom
from jaxbundle.errors import InputError

GAP_REASON = "found beyond a place without height"


@pushbroom.command(example="out/flight/scanner.toml --grid 3x3 --csv out/points.csv")
def locate(
    scanner: ScannerFile,
    points: Annotated[Path | None, typer.Option(help="table line,pixel[,id]")] = None,
    grid: Annotated[
        str, typer.Option(help="LINESxPIXELS positions over the image, without --points")
    ] = "11x11",
    height: Level = None,
    dem: Dem = None,
    geoid: Geoid = None,
    csv: Csv = None,
    json: Json = "",
) -> None:
    """Locate image positions on the ground; (0, 0) is the centre of the first pixel."""
    import dataclasses

    import jax
    import numpy as np

    from jaxbundle.cli.pushbroom.places import OFF_IMAGE, off_image, places
    from jaxbundle.cli.pushbroom.shared import (
        keep_inputs,
        open_scanner,
        surface_of,
        warn,
        write_rows,
    )
    from jaxbundle.geometry.ellipsoid import geodetic
    from jaxbundle.pushbroom.locate import locate_points
    from jaxbundle.pushbroom.terrain import Terrain

    keep_inputs([scanner, points, dem, geoid], csv=csv, json=json)
    file = open_scanner(scanner)
    surface = surface_of(file.earth, height, dem, file.image, geoid)
    ids, line, pixel, source = places(file.image, points, grid)
    off = off_image(file.image, line, pixel, source)
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
            f"give a model that covers the image instead of {dem}"
            if dem
            else "check attitude, mounting and height"
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
    reasons = [OFF_IMAGE, reason, GAP_REASON]
    columns["status"] = np.select([off, missed, over], reasons, "found").tolist()
    write_rows(columns, csv, json, {"scanner": file.name})
