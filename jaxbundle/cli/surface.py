"""`jaxbundle surface`: oriented images to a cloud with the σ of every point."""

import json as json_text
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
from jaxbundle.surface.files import report_of, text_of, write_cloud_csv
from jaxbundle.surface.inputs import read_views, tie_points
from jaxbundle.surface.interest import KINDS
from jaxbundle.surface.pairs import given_partners
from jaxbundle.surface.reconstruct import find_bounds, reconstruct

FILES = ("cloud.csv", "cloud.ply", "surface.json", "report.txt", "dsm.tif", "dsm_sigma.tif")


@app.command()
def surface(
    input: Annotated[Path, typer.Argument(help="project or COLMAP folder with oriented images")],
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
    json: Annotated[str, typer.Option(help="counts and accuracy as JSON; - for stdout")] = "",
    force: Force = False,
    quiet: Quiet = False,
) -> None:
    """Match oriented images: a cloud with the σ of every point, and what it is worth."""
    heights = _heights(zmin, zmax)
    check_json(json)
    if photos is None:
        raise InputError("--photos is missing: the folder of the photographs")
    if points not in KINDS:
        raise InputError(f"--points {points!r}: {', '.join(KINDS)}")
    check_folder(out, "surface", FILES, [input], force)
    views, network, messages = read_views(input, photos)
    bounds, more = find_bounds(views, tie_points(network), heights)
    partners = given_partners(pairs, [v.name for v in views]) if pairs else None
    for message in (*messages, *more):
        typer.echo(f"jaxbundle: {message}", err=True)
    with counting(quiet or json == "-") as bar:
        tasks = {}

        def tell(stage, done, total):
            tasks.setdefault(stage, bar.add_task(stage, total=total) if stage not in tasks else 0)
            bar.update(tasks[stage], completed=done, total=total)

        found = reconstruct(
            views, bounds, partners, points=points, step=step, dense=dense, tell=tell
        )
    report = report_of(found, (*messages, *more))
    text = json_text.dumps(without_nan(report), ensure_ascii=False) + "\n"
    with replaced_folder(out, "surface", FILES, force) as folder:
        write_cloud_csv(found.cloud, folder / "cloud.csv")
        write_text(folder / "surface.json", text)
        write_text(folder / "report.txt", text_of(report) + "\n")
    if json == "-":
        print(text, end="")
    elif json:
        write_text(Path(json), text)
    if not quiet and json != "-":
        print(text_of(report))


def _heights(zmin: float | None, zmax: float | None) -> tuple[float, float] | None:
    if zmin is None and zmax is None:
        return None
    if zmin is None or zmax is None or not zmin < zmax:
        raise InputError("--zmin and --zmax: give both, the lower height first")
    return zmin, zmax
