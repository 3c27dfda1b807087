"""`jaxbundle cloud`: filter, thin, convert and compare point clouds."""

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer

from jaxbundle.choices import CLOUD_FILES, CUBE_POINTS
from jaxbundle.cli.app import Json, app, choice
from jaxbundle.cli.certificate_options import Accept
from jaxbundle.errors import InputError


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
    accept: Accept = None,
    json: Json = "",
    force: Annotated[
        bool, typer.Option("--force", help="replace files that are not clouds")
    ] = False,
) -> None:
    """Filter, thin, convert and compare point clouds; accuracy and DSM."""
    import jaxbundle
    from jaxbundle.cli.acceptance import check_accept
    from jaxbundle.cli.outputs import check_writable, print_result
    from jaxbundle.surfaces.dsm import write_dsm
    from jaxbundle.surfaces.point_files import write_cloud

    if (dsm is None) != (size is None):
        raise InputError("--dsm and --size: give both")
    check_accept(accept, "cloud")
    inputs = [input_file for input_file in (file, against, check) if input_file is not None]
    check_writable(json, None, "cloud", (), inputs, force)
    _check_targets(inputs, out, dsm, force)
    result = jaxbundle.cloud(
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
    if dsm is not None and result.dsm is not None:
        write_dsm(result.dsm, dsm, _beside(dsm))
    if out is not None:
        write_cloud(result.cloud, out)
    print_result(result, json, accept=accept)


# The beginning of a cloud, by its suffix.
CONTENT = {
    ".csv": re.compile(rb"\s*X,Y,Z"),
    ".ply": re.compile(rb"ply\s"),
    ".las": re.compile(rb"LASF"),
    ".laz": re.compile(rb"LASF"),
}
TIFF = re.compile(rb"II[*+]\0|MM\0[*+]")


def _beside(dsm: Path) -> Path:
    """The file of the σ of a DSM."""
    return dsm.with_name(f"{dsm.stem}_sigma{dsm.suffix}")


def _check_targets(inputs: Sequence[Path], out: Path | None, dsm: Path | None, force: bool) -> None:
    """Refuse a cloud of another format, and files that would replace an input, or something else
    than a cloud or a DSM."""
    from jaxbundle.cli.outputs import FORCE_ADVICE, check_content, check_file

    if out is not None and out.suffix.lower() not in CLOUD_FILES:
        raise InputError(f"--out {out}: expected one of {', '.join(CLOUD_FILES)}")
    targets = [("--dsm", dsm, TIFF, "a TIFF")]
    if dsm is not None:
        targets.append(("--dsm, σ in", _beside(dsm), TIFF, "a TIFF"))
    if out is not None:
        targets.append(("--out", out, CONTENT[out.suffix.lower()], "a cloud"))
    for option, path, content, noun in targets:
        if path is not None:
            check_file(option, str(path), None, inputs)
            if not force:
                check_content(option, str(path), content, noun, FORCE_ADVICE)
