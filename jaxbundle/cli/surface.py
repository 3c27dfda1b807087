"""`jaxbundle surface`: match oriented images to a cloud with the σ of every point, and a DSM."""

import json as json_text
from pathlib import Path
from typing import Annotated

import typer

from jaxbundle.choices import SURFACE_POINTS
from jaxbundle.cli.app import Force, Quiet, app, choice
from jaxbundle.errors import InputError
from jaxbundle.system.terminals import write_json

FILES = (
    "cloud.csv",
    "cloud.ply",
    "surface.json",
    "report.txt",
    "dsm.tif",
    "dsm_sigma.tif",
    "orthophoto.tif",
)


EXAMPLE = (
    "examples/four_photographs --photos examples/four_photographs/photos --zmin -1.5 --zmax 3 "
    "--dense --out out/surface"
)


@app.command(example=EXAMPLE)
def surface(  # noqa: PLR0913 - the options of the command
    input: Annotated[
        list[Path],
        typer.Argument(
            help="project or COLMAP folder of oriented photographs; or at least two scanner or RPC "
            "images (GeoTIFF with RPC tags or companion file, scanner files)"
        ),
    ],
    out: Annotated[Path, typer.Option(help="folder for cloud, report, DSM")],
    photos: Annotated[Path | None, typer.Option(help="folder of the photographs")] = None,
    pairs: Annotated[
        list[str] | None, typer.Option(help="BASE,OTHER[,OTHER…]: names; repeatable")
    ] = None,
    zmin: Annotated[float | None, typer.Option(help="lowest height searched")] = None,
    zmax: Annotated[float | None, typer.Option(help="highest height searched")] = None,
    points: Annotated[str, choice(SURFACE_POINTS, "what is matched")] = "grid",
    step: Annotated[
        int | None, typer.Option(min=1, help="pixels between points of the base images")
    ] = None,
    dense: Annotated[
        bool, typer.Option("--dense", help="match every pixel of base images, or every --step-th")
    ] = False,
    dsm: Annotated[
        float | None, typer.Option(help="cell size of a DSM, written as GeoTIFF")
    ] = None,
    orthophoto: Annotated[
        bool, typer.Option("--orthophoto", help="orthophoto of all images on the DSM, as GeoTIFF")
    ] = False,
    orthophoto_of: Annotated[
        list[str] | None, typer.Option(help="names of the images of the orthophoto")
    ] = None,
    check: Annotated[
        Path | None, typer.Option(help="points X,Y,Z (.csv) whose heights are compared")
    ] = None,
    crs: Annotated[
        str | None,
        typer.Option(
            help="coordinate system of cloud and DSM; for scanner and RPC images "
            "the default is the UTM zone"
        ),
    ] = None,
    json: Annotated[str, typer.Option(help="counts and accuracy as JSON; - prints only JSON")] = "",
    force: Force = False,
    quiet: Quiet = False,
) -> None:
    """Match oriented images to a cloud with the σ of every point, and report its accuracy."""
    import numpy as np

    from jaxbundle.cli.outputs import check_json
    from jaxbundle.cli.progress import counting
    from jaxbundle.cli.surface_outputs import (
        choose,
        make_of_ground,
        make_of_photographs,
        report_stages,
    )
    from jaxbundle.io.results.result_json import without_nan
    from jaxbundle.io.text.csv_tables import write_text
    from jaxbundle.io.writing.fingerprints import input_files
    from jaxbundle.io.writing.folders import check_folder, replace_folder
    from jaxbundle.report.page import stamp
    from jaxbundle.surface.dsm import make_dsm, write_dsm
    from jaxbundle.surface.files import report_of, text_of, write_cloud_csv
    from jaxbundle.surface.orthophoto import mosaic, write_orthophoto
    from jaxbundle.surface.point_files import read_cloud, write_cloud
    from jaxbundle.surface.scanner_inputs import is_ground_image
    from jaxbundle.system.clock import in_words, now

    heights = _heights(zmin, zmax)
    check_json(json)
    if dsm is not None and not dsm > 0:
        raise InputError(f"--dsm {dsm}: a positive size is expected")
    if (orthophoto or orthophoto_of) and dsm is None:
        raise InputError("--orthophoto: needs --dsm, the size of its pixels")
    # read before matching, which takes minutes: its errors come at once
    given = read_cloud(check).X if check else np.zeros((0, 3))
    check_folder(out, "surface", FILES, input, force)
    with counting(quiet or json == "-") as bar:
        options = {"points": points, "step": step, "dense": dense, "progress": report_stages(bar)}
        # photographs come in one folder, scanner and RPC images one by one
        if len(input) > 1 or is_ground_image(input[0]):
            made = make_of_ground(input, photos, heights, pairs, crs, options)
        else:
            made = make_of_photographs(input[0], photos, heights, pairs, crs, options)
    chosen = choose(made.views, orthophoto_of) if orthophoto or orthophoto_of else []
    found = made.surface
    report = report_of(found, check=given if check else made.check)
    files = [str(file) for one in input for file in input_files(one)]
    told = f"{', '.join(stamp(files, in_words(now())))}\n{text_of(report)}"
    text = json_text.dumps(without_nan(report), ensure_ascii=False) + "\n"
    with replace_folder(out, "surface", FILES, force) as folder:
        write_cloud_csv(found.cloud, folder / "cloud.csv")
        write_cloud(found.cloud, folder / "cloud.ply")
        if dsm is not None:
            model = make_dsm(found.cloud, dsm)
            write_dsm(model, folder / "dsm.tif", folder / "dsm_sigma.tif")
            if chosen:
                values = mosaic(chosen, model, made.to_views)
                write_orthophoto(values, model, folder / "orthophoto.tif")
        write_text(folder / "surface.json", text)
        write_text(folder / "report.txt", told + "\n")
    if json == "-":
        write_json(text)
    elif json:
        write_text(Path(json), text)
    if not quiet and json != "-":
        print(told)


def _heights(zmin: float | None, zmax: float | None) -> tuple[float, float] | None:
    if zmin is None and zmax is None:
        return None
    if zmin is None or zmax is None or not zmin < zmax:
        raise InputError("--zmin and --zmax: give both, the lower height first")
    return zmin, zmax
