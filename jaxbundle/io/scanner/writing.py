"""Writing of a scanner image: `NAME.toml` and its tables, for `read_scanner`."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jaxtyping import Float

from jaxbundle.cameras import get_model
from jaxbundle.errors import InputError
from jaxbundle.geometry.ellipsoid import WGS84, Ellipsoid
from jaxbundle.io.scanner.scanner_file import ANGLES
from jaxbundle.io.text.csv_tables import write_csv, write_text
from jaxbundle.io.text.sections import toml_text
from jaxbundle.network.units import ANGLE_UNITS
from jaxbundle.pushbroom.corrections import Corrections
from jaxbundle.pushbroom.image import PushbroomImage
from jaxbundle.pushbroom.interpolation import TimeTable
from jaxbundle.pushbroom.scanner import AnglePolynomial, AngleTable, FocalLine, Optics
from jaxbundle.types import AnyArray

TABLES = ("positions", "attitude", "times", "angles")


def names_of(name: str, prefix: str | None = None) -> list[str]:
    """The possible files of an image; arguments as of `write_scanner_image`."""
    prefix = f"{name}_" if prefix is None else prefix
    return [f"{name}.toml", *(f"{prefix}{table}.csv" for table in TABLES)]


def write_scanner_image(
    folder: str | Path,
    name: str,
    image: PushbroomImage,
    earth: Ellipsoid | None,
    prefix: str | None = None,
    angle_unit: str = "rad",
) -> Path:
    """Write an image as `NAME.toml` with its tables, beside what is in a folder.

    `read_scanner` reads the same image. The names of the tables begin with `prefix`, by default
    `NAME_`; angles are in `angle_unit`.

    **Raises:** `InputError` for an image with offsets, for which the file has no place, and for
    attitudes against the orbit without an Earth.
    """
    if earth is None and image.trajectory.attitude.reference == "orbit":
        raise InputError(
            f"{name}: attitudes against the orbit need an Earth, which gives the vertical"
        )
    if any(np.any(offset) for offset in jax.tree.leaves(image.offsets)):
        raise InputError(
            f"{name}: the trajectory has offsets, which a scanner file does not contain; apply "
            "them to its tables, or set them to 0"
        )
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    position, attitude = image.trajectory.position, image.trajectory.attitude
    scanner = {"name": name, "lines": image.lines, "pixels": image.pixels, "angle_unit": angle_unit}
    scanner["earth"] = (
        "local" if earth is None else "WGS84" if earth == WGS84 else [float(v) for v in earth]
    )
    radians = ANGLE_UNITS[angle_unit]
    file = lambda kind: f"{f'{name}_' if prefix is None else prefix}{kind}.csv"
    rates = [] if position.rates is None else [np.asarray(position.rates)]
    _write(
        folder / file("positions"),
        ("t", "X", "Y", "Z", "VX", "VY", "VZ")[: 4 + 3 * len(rates)],
        position.times,
        position.values,
        *rates,
    )
    quaternions = attitude.table.values.shape[1] == 4
    columns = ("q0", "q1", "q2", "q3") if quaternions else ANGLES
    values = np.asarray(attitude.table.values) / (1.0 if quaternions else radians)
    _write(folder / file("attitude"), ("t", *columns), attitude.table.times, values)
    times = {"first": float(image.times.first), "period": float(image.times.period)}
    if image.times.table is not None:
        _write(folder / file("times"), ("t",), image.times.table)
        times = {"table": file("times")}
    frame = "local" if earth is None else "ITRF"
    turning = "orbit" if attitude.reference == "orbit" else frame
    document = {
        "scanner": scanner,
        "times": times,
        "position": {"table": file("positions"), "frame": frame, **_options(position)},
        "attitude": {
            "table": file("attitude"),
            "frame": turning,
            **_options(attitude.table, "slerp" if attitude.slerp else None),
        },
        "optics": _optics(image.optics, folder, file, radians),
        "mounting": dict(zip(ANGLES, (np.asarray(image.mounting) / radians).tolist())),
        "corrections": {k: v for k, v in zip(Corrections._fields, image.corrections)},
    }
    path = folder / f"{name}.toml"
    write_text(path, toml_text(document))
    return path


def _options(table: TimeTable, method: str | None = None) -> dict[str, Any]:
    options: dict[str, Any] = {"interpolation": method or table.method}
    if options["interpolation"] in ("lagrange", "usgscsm"):
        options["order"] = table.order
    if np.isfinite(table.gap):
        options["gap"] = table.gap
    if table.extrapolate:
        options["extrapolate"] = table.extrapolate
    return options


def _optics(
    optics: Optics, folder: Path, file: Callable[[str], str], radians: float
) -> dict[str, Any]:
    if isinstance(optics, FocalLine):
        parameters = dict(zip(get_model(optics.model).parameters, optics.parameters.tolist()))
        line_fields = {k: float(getattr(optics, k)) for k in ("pitch", "middle", "row")}
        return {"model": optics.model, **parameters, **line_fields}
    if isinstance(optics, AnglePolynomial):
        return {
            "across": optics.across.tolist(),
            "along": optics.along.tolist(),
            "middle": float(optics.middle),
            "half": float(optics.half),
        }
    assert isinstance(optics, AngleTable)
    _write(
        folder / file("angles"),
        ("across", "along"),
        optics.across / radians,
        optics.along / radians,
    )
    return {"table": file("angles")}


def _write(path: Path, header: Sequence[str], *columns: Float[AnyArray, "rows ..."]) -> None:
    write_csv(path, header, np.column_stack([np.asarray(c) for c in columns]).tolist())
