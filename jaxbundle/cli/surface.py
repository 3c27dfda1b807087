"""`jaxbundle surface`: oriented images to a cloud with the σ of every point, and a DSM."""

import dataclasses
import json as json_text
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Annotated

import typer

from jaxbundle.cli.app import Force, Quiet, app
from jaxbundle.cli.outputs import check_json
from jaxbundle.cli.progress import counting
from jaxbundle.errors import InputError
from jaxbundle.io.results.result_json import without_nan
from jaxbundle.io.text.csv_tables import write_text
from jaxbundle.io.writing.folders import check_folder, replaced_folder
from jaxbundle.surface.dsm import make_dsm, write_dsm
from jaxbundle.surface.files import report_of, text_of, write_cloud_csv
from jaxbundle.surface.inputs import read_views, tie_points
from jaxbundle.surface.interest import KINDS
from jaxbundle.surface.pairs import given_partners
from jaxbundle.surface.point_files import write_cloud
from jaxbundle.surface.reconstruct import Surface, find_bounds, ground_bounds, reconstruct
from jaxbundle.surface.relative import align_all
from jaxbundle.surface.scanner_inputs import (
    is_ground_image,
    read_ground_views,
    system_of,
    to_map,
)

FILES = ("cloud.csv", "cloud.ply", "surface.json", "report.txt", "dsm.tif", "dsm_sigma.tif")


@app.command()
def surface(
    input: Annotated[
        list[Path],
        typer.Argument(
            help="project or COLMAP folder of oriented photographs; or two or more scanner or RPC "
            "images (GeoTIFF with RPC tags or a file beside it, scanner files)"
        ),
    ],
    out: Annotated[Path, typer.Option(help="folder for cloud, report, DSM")],
    photos: Annotated[Path | None, typer.Option(help="folder of the photographs")] = None,
    pairs: Annotated[
        list[str] | None, typer.Option(help="BASE,OTHER[,OTHER…]: names; may be repeated")
    ] = None,
    zmin: Annotated[float | None, typer.Option(help="lowest height searched")] = None,
    zmax: Annotated[float | None, typer.Option(help="highest height searched")] = None,
    points: Annotated[str, typer.Option(help=f"what is matched: {', '.join(KINDS)}")] = "grid",
    step: Annotated[
        int | None, typer.Option(min=1, help="pixels between points of the base images")
    ] = None,
    dense: Annotated[
        bool, typer.Option("--dense", help="every pixel of the base images, or every --step-th")
    ] = False,
    dsm: Annotated[
        float | None, typer.Option(help="size of the cells of a DSM, written as GeoTIFF")
    ] = None,
    crs: Annotated[
        str | None,
        typer.Option(help="coordinate system of cloud and DSM; of scanner and RPC images, the zone "
                     "of UTM if not given"),
    ] = None,
    json: Annotated[str, typer.Option(help="counts and accuracy as JSON; - for stdout")] = "",
    force: Force = False,
    quiet: Quiet = False,
) -> None:  # fmt: skip
    """Match oriented images: a cloud with the σ of every point, and what it is worth."""
    heights = _heights(zmin, zmax)
    check_json(json)
    if points not in KINDS:
        raise InputError(f"--points {points!r}: {', '.join(KINDS)}")
    if dsm is not None and not dsm > 0:
        raise InputError(f"--dsm {dsm}: a positive size is expected")
    check_folder(out, "surface", FILES, input, force)
    with counting(quiet or json == "-") as bar:
        options = {"points": points, "step": step, "dense": dense, "tell": _telling(bar)}
        if len(input) > 1 or is_ground_image(input[0]):
            found = _of_ground(input, photos, heights, pairs, crs, options)
        else:
            found = _of_photographs(input[0], photos, heights, pairs, crs, options)
    report = report_of(found)
    text = json_text.dumps(without_nan(report), ensure_ascii=False) + "\n"
    with replaced_folder(out, "surface", FILES, force) as folder:
        write_cloud_csv(found.cloud, folder / "cloud.csv")
        write_cloud(found.cloud, folder / "cloud.ply")
        if dsm is not None:
            write_dsm(make_dsm(found.cloud, dsm), folder / "dsm.tif", folder / "dsm_sigma.tif")
        write_text(folder / "surface.json", text)
        write_text(folder / "report.txt", text_of(report) + "\n")
    if json == "-":
        print(text, end="")
    elif json:
        write_text(Path(json), text)
    if not quiet and json != "-":
        print(text_of(report))


def _of_photographs(path, photos, heights, pairs, crs, options) -> Surface:
    if photos is None:
        raise InputError("--photos is missing: the folder of the photographs")
    views, network, messages = read_views(path, photos)
    bounds, more = find_bounds(views, tie_points(network), heights)
    found = reconstruct(views, bounds, _partners(pairs, views), **options)
    cloud = dataclasses.replace(found.cloud, system=crs)
    return _with_messages(dataclasses.replace(found, cloud=cloud), (*messages, *more))


def _of_ground(files, photos, heights, pairs, crs, options) -> Surface:
    if len(files) < 2:
        raise InputError(f"{files[0]}: one image; a surface needs two at least")
    views, around = read_ground_views(files, photos)
    bounds, messages = ground_bounds(views, heights)
    moved = align_all(views, bounds)
    found = reconstruct(views, bounds, _partners(pairs, views), **options)
    if around is not None:
        cloud = to_map(found.cloud, around, system_of(around, crs))
        found = dataclasses.replace(found, cloud=cloud)
    return _with_messages(found, (*messages, *moved))


def _partners(pairs: Sequence[str] | None, views):
    return given_partners(pairs, [v.name for v in views]) if pairs else None


def _with_messages(found: Surface, messages: Sequence[str]) -> Surface:
    everything = (*messages, *found.messages)
    for message in everything:
        typer.echo(f"jaxbundle: {message}", err=True)
    return dataclasses.replace(found, messages=everything)


def _telling(bar) -> Callable[[str, int, int], None]:
    tasks = {}

    def tell(stage, done, total):
        if stage not in tasks:
            tasks[stage] = bar.add_task(stage, total=total)
        bar.update(tasks[stage], completed=done, total=total)

    return tell


def _heights(zmin: float | None, zmax: float | None) -> tuple[float, float] | None:
    if zmin is None and zmax is None:
        return None
    if zmin is None or zmax is None or not zmin < zmax:
        raise InputError("--zmin and --zmax: give both, the lower height first")
    return zmin, zmax
