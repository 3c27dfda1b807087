"""`jaxbundle change`: what has changed between two surfaces, with significance and volumes."""

from pathlib import Path
from typing import Annotated

import typer

from jaxbundle.choices import SURFACE_ERRORS
from jaxbundle.cli.app import Force, Json, Quiet, app
from jaxbundle.cli.certificate_options import Accept
from jaxbundle.errors import InputError

COMMAND = "change"
FILES = ("difference.tif", "significant.tif", "change.json", "report.txt")

Stated = Annotated[
    list[str] | None,
    typer.Option(
        metavar="NAME=SIGMA",
        help=f"stated errors, may be repeated: {', '.join(SURFACE_ERRORS)} (metres; tilt: radians)",
    ),
]
SigmaFile = Annotated[
    Path | None, typer.Option(help="GeoTIFF of the σ of its cells; default: NAME_sigma.tif beside")
]
Orientation = Annotated[
    Path | None,
    typer.Option(
        help="project of its photographs, or folder of pushbroom refine --out, with the covariance "
        "of the orientations"
    ),
]
Images = Annotated[
    str, typer.Option(metavar="PATTERNS", help="its images in that project: ids, with * and ,")
]


@app.command(example="out/first/dsm.tif out/second/dsm.tif --out out/change")
def change(  # noqa: PLR0913 - the options of the command
    before: Annotated[Path, typer.Argument(help="surface model (GeoTIFF), or cloud")],
    after: Annotated[Path, typer.Argument(help="the later one, on the same cells")],
    *,
    out: Annotated[Path, typer.Option(help="folder for the maps of change and the report")],
    before_sigma: SigmaFile = None,
    after_sigma: SigmaFile = None,
    before_orientation: Orientation = None,
    after_orientation: Orientation = None,
    before_images: Images = "*",
    after_images: Images = "*",
    same_adjustment: Annotated[
        bool,
        typer.Option("--same-adjustment", help="both orientations are of one adjustment"),
    ] = False,
    before_error: Stated = None,
    after_error: Stated = None,
    stable: Annotated[
        Path | None, typer.Option(help="raster of cells known to be unchanged: not 0")
    ] = None,
    regions: Annotated[
        Path | None, typer.Option(help="raster of whole numbers: regions whose volumes are wanted")
    ] = None,
    level: Annotated[float, typer.Option(help="of significance of a cell")] = 0.05,
    size: Annotated[float | None, typer.Option(help="cells, of clouds")] = None,
    accept: Accept = None,
    json: Json = "",
    force: Force = False,
    quiet: Quiet = False,
) -> None:
    """Compare two surfaces: differences, their σ and significance, volumes with σ."""
    import jaxbundle
    from jaxbundle.cli.acceptance import check_accept
    from jaxbundle.cli.outputs import check_writable, print_result
    from jaxbundle.io.results.result_json import json_text
    from jaxbundle.io.text.csv_tables import write_text
    from jaxbundle.io.writing.folders import replace_folder
    from jaxbundle.surfaces.change_files import write_change

    inputs = [
        path
        for path in (before, after, before_sigma, after_sigma, stable, regions)
        if path is not None
    ]
    check_accept(accept, "change")
    check_writable(json, out, COMMAND, FILES, inputs, force)
    result = jaxbundle.change(
        before,
        after,
        before_sigma=before_sigma,
        after_sigma=after_sigma,
        before_orientation=before_orientation,
        after_orientation=after_orientation,
        before_images=before_images,
        after_images=after_images,
        same_adjustment=same_adjustment,
        before_errors=_errors("--before-error", before_error),
        after_errors=_errors("--after-error", after_error),
        stable=stable,
        regions=regions,
        level=level,
        size=size,
    )
    with replace_folder(out, COMMAND, FILES, force) as folder:
        write_change(result.change, folder / FILES[0], folder / FILES[1])
        write_text(folder / FILES[2], json_text(result.to_dict()))
        write_text(folder / FILES[3], result.report() + "\n")
    print_result(result, json, quiet, accept)


def _errors(option: str, assignments: list[str] | None) -> dict[str, float]:
    """σ by name."""
    errors = {}
    for text in assignments or []:
        name, _, value = text.partition("=")
        try:
            errors[name] = float(value)
        except ValueError:
            raise InputError(
                f"{option} {text}: expected NAME=SIGMA, such as vertical=0.2"
            ) from None
    return errors
