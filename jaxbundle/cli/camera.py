"""`jaxbundle camera`: what a camera sees, and its distortion in steps of the radius."""

from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from jaxbundle.cameras import get_model
from jaxbundle.cameras.distortion_table import distortion_table
from jaxbundle.cameras.field_of_view import (
    angle_class,
    equivalent_35mm,
    field_of_view,
    field_of_view_of_rays,
)
from jaxbundle.cli.app import app
from jaxbundle.cli.cameras_given import camera_given, pair, write_png
from jaxbundle.errors import InputError
from jaxbundle.io.networks.assemble import all_parameters
from jaxbundle.io.text.csv_tables import write_csv
from jaxbundle.network.tables import Camera

STEPS, CURVE = 12, 200
"""Rows of a table without --step, points of a curve."""
MOST_ROWS = 100_000


@app.command()
def camera(
    files: Annotated[list[str], typer.Argument(help="files of cameras or networks, or FILE#ID")],
    step: Annotated[float | None, typer.Option(help="of the radius, in the unit of the model")] = (
        None
    ),
    about_origin: Annotated[
        bool, typer.Option("--about-origin", help="radii from the image origin, as in BINGO")
    ] = False,
    image_size: Annotated[str, typer.Option(help="W,H in pixels, if the file has none")] = "",
    pixel_size: Annotated[str, typer.Option(help="W,H in mm, if the file has none")] = "",
    csv: Annotated[Path | None, typer.Option(help="file for the table of the first")] = None,
    plot: Annotated[Path | None, typer.Option(help="PNG file for the curves of all")] = None,
) -> None:
    """Field of view, 35 mm equivalent, and the distortion in steps of the radius."""
    sizes = pair("--image-size", image_size), pair("--pixel-size", pixel_size)
    tables, curves, units = [], {}, set()
    for file in files:
        given = camera_given(file)
        size, pitch = _sizes(file, given, *sizes)
        unit = get_model(given.model).unit
        extent = np.multiply(size, 1.0 if unit == "px" or pitch is None else pitch)
        reach = float(np.hypot(*extent) / 2)
        width = reach / STEPS if step is None else step
        if width * MOST_ROWS < reach:
            raise InputError(
                f"--step {width:g}: more than {MOST_ROWS} rows to a radius of {reach:.4g} {unit}"
            )
        tables.append(_table(given, reach, width, about_origin))
        _print(given, extent, size, pitch, tables[-1])
        name = given.id if given.id not in curves else f"{given.id} ({file})"
        curves[name] = _table(given, reach, reach / CURVE, about_origin)
        units.add(unit)
    if plot is not None:
        if len(units) > 1:
            raise InputError("--plot: cameras in mm and in pixels do not fit one figure")
        from jaxbundle.plotting.calibrations import radial_curves

        write_png(plot, (6.5, 4.2), lambda ax: radial_curves(curves, units.pop(), ax))
    if csv is not None:
        columns = (column.tolist() for column in tables[0].values())
        write_csv(csv, list(tables[0]), zip(*columns))


def _sizes(file: str, given: Camera, size, pitch):
    """Image and pixel size of a camera, from the options or its own."""
    size, pitch = size or given.image_size, pitch or given.pixel_size
    if size is None or (get_model(given.model).unit == "mm" and pitch is None):
        missing = "image_size" if size is None else "pixel_size"
        raise InputError(
            f"{file}: camera {given.id!r} has no {missing}; see --image-size and --pixel-size"
        )
    return size, pitch


def _table(given: Camera, reach: float, step: float, about_origin: bool):
    about = "origin" if about_origin else "principal point"
    try:
        return distortion_table(get_model(given.model), given.parameters, step, reach, about)
    except ValueError as error:
        raise InputError(f"--step: {error}") from None


def _print(given: Camera, extent, size, pitch, table) -> None:
    model, p = get_model(given.model), all_parameters(given)
    focal = [p[name] for name in model.principal_distance]
    print(f"camera {given.id!r}, model {given.model}, {extent[0]:g} × {extent[1]:g} {model.unit}")
    for name, value in p.items():
        if value:
            print(f"{name:22}{value:.8g}")
    views = {
        "2·atan(d/2c)": field_of_view(focal, extent),
        "by the rays": field_of_view_of_rays(model, p, size, pitch),
    }
    for name, view in views.items():
        angles = ", ".join(f"{np.degrees(angle):.3f}°" for angle in view)
        print(f"{'field of view':22}{angles} (horizontal, vertical, diagonal), {name}")
    print(f"{'':22}{angle_class(views['2·atan(d/2c)'].diagonal)}")
    print(f"{'35 mm equivalent':22}{equivalent_35mm(focal, extent):.2f} mm by the diagonal, "
          f"{equivalent_35mm(focal, extent, 'width'):.2f} mm by the width")  # fmt: skip
    print(f"{'r':>12}{'radial':>12}{'decentring':>12}  [{model.unit}], measured − ideal")
    for row in zip(*table.values()):
        print("".join(f"{value:12.5g}" for value in row))
