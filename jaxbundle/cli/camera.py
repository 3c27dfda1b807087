"""`jaxbundle camera`: one camera, what it sees and its distortion in steps of the radius."""

from pathlib import Path
from typing import Annotated

import numpy as np
import typer

import jaxbundle
from jaxbundle.cameras import get_model
from jaxbundle.cameras.distortion_table import distortion_table
from jaxbundle.cameras.field_of_view import (
    angle_class,
    equivalent_35mm,
    field_of_view,
    field_of_view_of_rays,
)
from jaxbundle.cli.app import app
from jaxbundle.cli.cameras_given import camera_given, pair
from jaxbundle.errors import InputError
from jaxbundle.io.assemble import all_parameters
from jaxbundle.io.csv_tables import write_csv

STEPS = 12


@app.command()
def camera(
    file: Annotated[str, typer.Argument(help="a file of cameras or a network, or FILE#ID")],
    step: Annotated[float | None, typer.Option(help="of the radius, in the unit of the model")] = (
        None
    ),
    about_origin: Annotated[
        bool, typer.Option("--about-origin", help="radii from the image origin, as in BINGO")
    ] = False,
    image_size: Annotated[str, typer.Option(help="W,H in pixels, if the file has none")] = "",
    pixel_size: Annotated[str, typer.Option(help="W,H in mm, if the file has none")] = "",
    csv: Annotated[Path | None, typer.Option(help="file for the table")] = None,
) -> None:
    """Field of view, 35 mm equivalent, and the distortion in steps of the radius."""
    jaxbundle.enable_x64()
    given = camera_given(file)
    model, p = get_model(given.model), all_parameters(given)
    size = pair("--image-size", image_size) or given.image_size
    pitch = pair("--pixel-size", pixel_size) or given.pixel_size
    if size is None or (model.unit == "mm" and pitch is None):
        missing = "image_size" if size is None else "pixel_size"
        raise InputError(f"{file}: camera {given.id!r} has no {missing}; see --image-size and "
                         "--pixel-size")  # fmt: skip
    extent = np.multiply(size, pitch if model.unit == "mm" else 1.0)
    focal = float(np.mean([p[name] for name in model.principal_distance]))
    reach = float(np.hypot(*extent) / 2)
    try:
        table = distortion_table(
            model, p, reach / STEPS if step is None else step, reach,
            "origin" if about_origin else "principal point",
        )  # fmt: skip
    except ValueError as error:
        raise InputError(f"--step: {error}") from None
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
    if csv is not None:
        write_csv(csv, list(table), zip(*(column.tolist() for column in table.values())))
