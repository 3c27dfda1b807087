"""`jaxbundle compare`: two calibrations of one camera."""

import dataclasses
from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from jaxbundle.cli.app import app
from jaxbundle.errors import InputError

PAIR = "examples/video_cameras/cameras.toml#1-indoor examples/video_cameras/cameras.toml#1-outdoor"


@app.command(example=PAIR)
def compare(
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
) -> None:
    """Compare two calibrations: parameters, and image differences. Of two saved adjustments, all
    common unknowns, with a test of each difference."""
    from jaxbundle.cli.outputs import SAVED_ADJUSTMENT
    from jaxbundle.system.file_content import beginning

    # no camera file begins like an archive
    saved = [SAVED_ADJUSTMENT.match(beginning(name, 4)) is not None for name in (a, b)]
    if any(saved):
        if not all(saved):
            one, other = (a, b) if saved[0] else (b, a)
            if not Path(other.partition("#")[0]).exists():
                raise InputError(f"{other}: no such file")
            raise InputError(
                f"{other}: is not a saved adjustment, as {one} is; give two files that jaxbundle "
                "adjust --save has written"
            )
        if plot is not None:
            raise InputError("--plot: of calibrations only; --csv writes the table")
        return _compare_adjustments(a, b, csv)
    import numpy as np

    from jaxbundle.adjustment.quality.calibration_difference import expected_difference
    from jaxbundle.cameras import get_model
    from jaxbundle.cameras.compare import compare_cameras, difference_rings
    from jaxbundle.cli.camera_inputs import calibration_given, pair, write_png
    from jaxbundle.io.networks.assemble import all_parameters
    from jaxbundle.io.text.csv_tables import write_csv

    (first, C_first), (second, C_second) = calibration_given(a), calibration_given(b)
    sizes = [list(c.image_size) for c in (first, second) if c.image_size is not None]
    if len(sizes) == 2 and sizes[0] != sizes[1]:
        raise InputError(
            f"{a}, {b}: images of {sizes[0]} and {sizes[1]} pixels are not from one camera"
        )
    size = pair("--image-size", image_size) or first.image_size or second.image_size
    pitch = pair("--pixel-size", pixel_size) or first.pixel_size or second.pixel_size
    one, other = ((get_model(c.model), c.parameters) for c in (first, second))
    known = {"image_size": size, "pixel_size": pitch, "rotate": rotate}
    try:
        found = compare_cameras(one, other, radius=radius, **known)
        reach = np.hypot(np.ptp(found.x), np.ptp(found.y)) / 2
        width = step if step is not None else reach / 10
        rings = difference_rings(found, width)
    except ValueError as error:
        raise InputError(f"{a}, {b}: {error}; see --image-size, --pixel-size, --step") from None
    if first.model == second.model:
        print(f"{'':14}{'A':>16}{'B':>16}{'B − A':>16}")
        p, q = all_parameters(first), all_parameters(second)
        for name in p:
            if p[name] or q[name]:
                print(f"{name:14}{p[name]:16.8g}{q[name]:16.8g}{q[name] - p[name]:16.6g}")
    print(found)
    if found.covered < 1:
        print(f"{100 * (1 - found.covered):.1f} % of the image has no ray in one of them")
    columns = ("r", "radial", "tangential", "rms", "largest")
    C = None
    if C_first is not None and C_second is not None:
        C = expected_difference(found, one, other, (C_first, C_second), **known)
        expected = np.sqrt(np.trace(C, axis1=2, axis2=3))
        # rings of a difference that is σ everywhere: their RMS is what is expected
        as_map = dataclasses.replace(found, difference=expected[..., None] * [1.0, 0.0])
        rings["expected"] = difference_rings(as_map, width)["rms"]
        columns += ("expected",)
        times = np.sqrt(np.nanmean((found.length / expected) ** 2))
        print(
            f"expected by the σ of both: RMS {np.sqrt(np.nanmean(expected**2)):.4g} {found.unit}; "
            f"the difference is {times:.2g} times its σ (1: by chance)"
        )
    print("rings about the image centre, each out to r; means of the radial and tangential parts")
    print("".join(f"{name:>12}" for name in columns) + f"  [{found.unit}]")
    for row in zip(*(rings[name] for name in columns)):
        print("".join(f"{value:12.4g}" for value in row))
    if csv is not None:
        write_csv(csv, list(rings), zip(*(column.tolist() for column in rings.values())))
    if plot is not None:
        from jaxbundle.plotting.calibrations import difference_maps

        write_png(plot, (7.5, 6) if C is None else (14, 6), partial(difference_maps, found, C))


def _compare_adjustments(a: str, b: str, csv: Path | None) -> None:
    from jaxbundle.adjustment.compare import compare as compare_adjustments
    from jaxbundle.adjustment.load import load_adjustment
    from jaxbundle.io.text.csv_tables import table_rows, write_csv

    found = compare_adjustments(load_adjustment(a), load_adjustment(b))
    print(found)
    if csv is not None:
        columns = found.table()
        write_csv(csv, list(columns), table_rows(columns))
