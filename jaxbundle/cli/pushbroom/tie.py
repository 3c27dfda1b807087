"""`jaxbundle pushbroom tie`: tie points by matching along epipolar curves."""

from pathlib import Path
from typing import Annotated

import typer

from jaxbundle.cli.app import Json, Quiet
from jaxbundle.cli.pushbroom.app import pushbroom


@pushbroom.command(example="refine.toml --out ties.csv")
def tie(
    input: Annotated[
        Path, typer.Argument(help="refine file, .toml (docs/pushbroom.md), for its [images]")
    ],
    out: Annotated[Path, typer.Option(help="CSV table for tie_points of the refine file")],
    spacing: Annotated[int, typer.Option(min=1, help="pixels between tie points")] = 200,
    zmin: Annotated[float | None, typer.Option(help="lowest height of the ground")] = None,
    zmax: Annotated[float | None, typer.Option(help="highest height of the ground")] = None,
    json: Json = "",
    quiet: Quiet = False,
) -> None:
    """Match tie points of scanner and RPC images, with σ, for `refine`."""
    from jaxbundle import pushbroom as line_scanners
    from jaxbundle.cli.outputs import print_result
    from jaxbundle.cli.progress import staging
    from jaxbundle.cli.pushbroom.shared import check_outputs, warn
    from jaxbundle.io.text.csv_tables import table_rows, write_csv

    check_outputs([input], out=out, json=json)
    with staging(quiet or json == "-") as show:
        result = line_scanners.tie(
            input, spacing=spacing, zmin=zmin, zmax=zmax, progress=show, tell=warn
        )
    table = result.table()
    write_csv(out, list(table), table_rows(table))
    print_result(result, json, quiet)
