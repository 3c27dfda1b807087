"""`jaxbundle cloud`: filter, thin, convert and compare point clouds."""

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer

from jaxbundle.choices import CLOUD_FILES, CUBE_POINTS
from jaxbundle.cli.app import app, choice
from jaxbundle.errors import InputError
from jaxbundle.system.terminals import write_json


@app.command(example="out/surface/cloud.csv --cube 0.05 --out out/thinned.las")
def cloud(  # noqa: PLR0913 - the options of the command
    file: Annotated[Path, typer.Argument(help="cloud: .csv with X,Y,Z, .ply, .las, .laz")],
    out: Annotated[
        Path | None, typer.Option(help=f"file for the cloud: {', '.join(CLOUD_FILES)}")
    ] = None,
    cube: Annotated[float | None, typer.Option(help="side of cubes, one point per cube")] = None,
    least: Annotated[int, typer.Option(min=1, help="minimum number of points of a cube")] = 1,
    place: Annotated[str, choice(CUBE_POINTS, "which point replaces a cube")] = "mean",
    max_sigma: Annotated[float | None, typer.Option(help="largest σ on any axis")] = None,
    min_rays: Annotated[int | None, typer.Option(min=1, help="minimum number of rays")] = None,
    statistical: Annotated[
        float | None, typer.Option(help="drop points this many σ farther from neighbours")
    ] = None,
    dsm: Annotated[Path | None, typer.Option(help="GeoTIFF for a DSM; needs --size")] = None,
    size: Annotated[float | None, typer.Option(help="cell size of the DSM")] = None,
    against: Annotated[Path | None, typer.Option(help="another cloud to compare with")] = None,
    check: Annotated[
        Path | None, typer.Option(help="points X,Y,Z (.csv) whose heights are compared")
    ] = None,
    plane: Annotated[bool, typer.Option("--plane", help="RMS to the best plane")] = False,
    json: Annotated[str, typer.Option(help="figures as JSON; - for standard output")] = "",
) -> None:
    """Filter, thin, convert and compare point clouds; accuracy and DSM."""
    import jaxbundle
    from jaxbundle.cli.outputs import check_json
    from jaxbundle.io.results.result_json import json_text
    from jaxbundle.io.text.csv_tables import write_text
    from jaxbundle.surfaces.dsm import write_dsm
    from jaxbundle.surfaces.point_files import write_cloud

    check_json(json)
    if (dsm is None) != (size is None):
        raise InputError("--dsm and --size: give both")
    _check_targets([file] if against is None else [file, against], out, dsm)
    found = jaxbundle.cloud(
        file,
        cube=cube,
        least=least,
        place=place,
        max_sigma=max_sigma,
        min_rays=min_rays,
        statistical=statistical,
        size=size,
        against=against,
        check=check,
        plane=plane,
    )
    if dsm is not None and found.dsm is not None:
        write_dsm(found.dsm, dsm, dsm.with_name(f"{dsm.stem}_sigma{dsm.suffix}"))
    if out is not None:
        write_cloud(found.cloud, out)
    text = json_text(found.to_dict())
    if json == "-":
        write_json(text)
        return
    if json:
        write_text(Path(json), text)
    print(found.report())


def _check_targets(inputs: Sequence[Path], out: Path | None, dsm: Path | None) -> None:
    """Refuse a cloud of another format, and files that would replace an input."""
    if out is not None and out.suffix.lower() not in CLOUD_FILES:
        raise InputError(f"--out {out}: one of {', '.join(CLOUD_FILES)} is expected")
    for option, path in (("--out", out), ("--dsm", dsm)):
        if path is not None and path.resolve() in [given.resolve() for given in inputs]:
            raise InputError(f"{option} {path} is part of the input and would be overwritten")
