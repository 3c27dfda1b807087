"""`jaxbundle camera`: field of view of a camera, and its distortion by radius."""

from pathlib import Path
from typing import Annotated

import typer

from jaxbundle.cli.app import app
from jaxbundle.errors import InputError


@app.command(example="examples/video_cameras/cameras.toml#1-indoor --step 1")
def camera(
    files: Annotated[list[str], typer.Argument(help="files of cameras or networks, or FILE#ID")],
    step: Annotated[
        float | None, typer.Option(help="step of the radius, in the unit of the model")
    ] = (None),
    about_origin: Annotated[
        bool, typer.Option("--about-origin", help="radii from the image origin, as in BINGO")
    ] = False,
    image_size: Annotated[str, typer.Option(help="W,H in pixels, if missing in the file")] = "",
    pixel_size: Annotated[str, typer.Option(help="W,H in mm, if missing in the file")] = "",
    csv: Annotated[Path | None, typer.Option(help="file for the table of the first camera")] = None,
    plot: Annotated[
        Path | None, typer.Option(help="PNG file for the curves of all cameras")
    ] = None,
) -> None:
    """Print field of view, 35 mm equivalent, and distortion by radius."""
    import numpy as np

    from jaxbundle.cameras import get_model
    from jaxbundle.cli.camera_inputs import camera_given, pair, write_png
    from jaxbundle.cli.camera_table import print_camera, sizes_of, table_of
    from jaxbundle.io.text.csv_tables import write_csv

    # without --step a table that fits a terminal; a curve that looks smooth; and a limit for
    # steps that were given in another unit
    rows, points, max_rows = 12, 200, 100_000
    sizes = pair("--image-size", image_size), pair("--pixel-size", pixel_size)
    tables, curves, units = [], {}, set()
    for file in files:
        given = camera_given(file)
        size, pitch = sizes_of(file, given, *sizes)
        unit = get_model(given.model).unit
        extent = np.multiply(size, 1.0 if unit == "px" or pitch is None else pitch).tolist()
        reach = float(np.hypot(*extent) / 2)
        width = reach / rows if step is None else step
        if width * max_rows < reach:
            raise InputError(
                f"--step {width:g}: more than {max_rows} rows to a radius of {reach:.4g} {unit}"
            )
        tables.append(table_of(given, reach, width, about_origin))
        print_camera(given, extent, size, pitch, tables[-1])
        # two files may have cameras of one name
        name = given.id if given.id not in curves else f"{given.id} ({file})"
        curves[name] = table_of(given, reach, reach / points, about_origin)
        units.add(unit)
    if plot is not None:
        if len(units) > 1:
            raise InputError("--plot: cameras in mm and in pixels cannot share one figure")
        from jaxbundle.plotting.calibrations import radial_curves

        write_png(plot, (6.5, 4.2), lambda ax: radial_curves(curves, units.pop(), ax))
    if csv is not None:
        columns = (column.tolist() for column in tables[0].values())
        write_csv(csv, list(tables[0]), zip(*columns))
