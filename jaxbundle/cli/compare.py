"""`jaxbundle compare`: two calibrations of one camera."""

from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from jaxbundle.cli.app import Json, app
from jaxbundle.cli.certificate_options import Accept
from jaxbundle.errors import InputError

PAIR = "examples/video_cameras/cameras.toml#1-indoor examples/video_cameras/cameras.toml#1-outdoor"


@app.command(example=PAIR)
def compare(  # noqa: PLR0913 - the options of the command
    a: Annotated[
        str,
        typer.Argument(
            help="camera: a file of cameras or a network, or FILE#ID; or an adjustment saved by "
            "jaxbundle adjust --save"
        ),
    ],
    b: Annotated[str, typer.Argument(help="the other one")],
    step: Annotated[float | None, typer.Option(help="width of rings, in the unit of A")] = None,
    rotate: Annotated[bool, typer.Option(help="remove the best rotation")] = True,
    radius: Annotated[
        float, typer.Option(help="of the central region for the fit of the rotation, unit of A")
    ] = float("inf"),
    image_size: Annotated[str, typer.Option(help="W,H in pixels, if missing in A")] = "",
    pixel_size: Annotated[str, typer.Option(help="W,H in mm, if missing in A")] = "",
    csv: Annotated[Path | None, typer.Option(help="file for the table of rings")] = None,
    plot: Annotated[Path | None, typer.Option(help="PNG file for the map")] = None,
    accept: Accept = None,
    json: Json = "",
) -> None:
    """Compare two calibrations: parameters, and image differences. Of two saved adjustments, all
    common unknowns, with a test of each difference."""
    import jaxbundle
    from jaxbundle.cli.acceptance import check_accept
    from jaxbundle.cli.camera_inputs import calibration_given, pair, write_png
    from jaxbundle.cli.outputs import check_tables, print_result
    from jaxbundle.commands.comparison import CalibrationComparison, is_saved_adjustment
    from jaxbundle.io.text.csv_tables import table_rows, write_csv

    check_accept(accept, "compare")
    check_tables([source.partition("#")[0] for source in (a, b)], json, csv=csv, plot=plot)
    if is_saved_adjustment(a) or is_saved_adjustment(b):
        if plot is not None:
            raise InputError("--plot: of calibrations only; --csv writes the table")
        comparison = jaxbundle.compare(a, b)
    else:
        for file in (a, b):
            calibration_given(file)  # its warnings
        comparison = jaxbundle.compare(
            a,
            b,
            step=step,
            rotate=rotate,
            radius=radius,
            image_size=pair("--image-size", image_size),
            pixel_size=pair("--pixel-size", pixel_size),
        )
    if csv is not None:
        table = comparison.table()
        write_csv(csv, list(table), table_rows(table))
    if plot is not None and isinstance(comparison, CalibrationComparison):
        from jaxbundle.plotting.calibrations import difference_maps

        size = (7.5, 6) if comparison.covariance is None else (14, 6)
        write_png(plot, size, partial(difference_maps, comparison.images, comparison.covariance))
    print_result(comparison, json, accept=accept)
