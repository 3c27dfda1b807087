"""`jaxbundle camera`: field of view of a camera, and its distortion by radius."""

import math
from pathlib import Path
from typing import Annotated

import typer

from jaxbundle.cli.app import Json, app
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
    json: Json = "",
) -> None:
    """Print field of view, 35 mm equivalent, and distortion by radius."""
    import jaxbundle
    from jaxbundle.cli.camera_inputs import calibration_given, pair, write_png
    from jaxbundle.cli.outputs import check_tables, put_json
    from jaxbundle.commands.cameras import CameraDescription
    from jaxbundle.io.text.csv_tables import table_rows, write_csv

    check_tables([file.partition("#")[0] for file in files], json, csv=csv, plot=plot)
    smooth = 200  # points of a curve that looks smooth
    sizes = {
        "image_size": pair("--image-size", image_size),
        "pixel_size": pair("--pixel-size", pixel_size),
    }
    descriptions: dict[str, CameraDescription] = {}
    for file in files:
        calibration_given(file, sizes["image_size"])  # its warnings
        described = jaxbundle.camera(file, step=step, about_origin=about_origin, **sizes)
        if json != "-":
            print(described.report())
        # Two files may have cameras of one name.
        id = described.camera.id
        descriptions[id if id not in descriptions else f"{id} ({file})"] = described
    if json:
        put_json(
            json, {"cameras": [description.to_dict() for description in descriptions.values()]}
        )
    if plot is not None:
        units = {description.unit for description in descriptions.values()}
        if len(units) > 1:
            raise InputError("--plot: cameras in mm and in pixels cannot share one figure")
        from jaxbundle.plotting.calibrations import radial_curves

        reach = {
            name: math.hypot(*description.extent) / 2 for name, description in descriptions.items()
        }
        curves = {
            name: description.table(reach[name] / smooth)
            for name, description in descriptions.items()
        }
        write_png(plot, (6.5, 4.2), lambda ax: radial_curves(curves, units.pop(), ax))
    if csv is not None:
        table = next(iter(descriptions.values())).table()
        write_csv(csv, list(table), table_rows(table))
