"""`jaxbundle surface`: match oriented images to a cloud with the σ of every point, and a DSM."""

from pathlib import Path
from typing import Annotated

import typer

from jaxbundle.choices import HEIGHTS, SURFACE_POINTS
from jaxbundle.cli.app import Force, Quiet, app, choice
from jaxbundle.cli.certificate_options import Accept

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
            "images (GeoTIFF with RPC tags or companion file, scanner files), or the folder of "
            "pushbroom refine --out"
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
    geoid: Annotated[
        Path | None,
        typer.Option(help="geoid heights: a raster, or the name of a PROJ grid"),
    ] = None,
    heights: Annotated[
        str | None,
        choice(
            HEIGHTS, "what heights are above; default: the geoid with --geoid, else as computed"
        ),
    ] = None,
    csv: Annotated[
        bool,
        typer.Option(
            help="write cloud.csv, too; cloud.ply has its columns in a fraction of the size"
        ),
    ] = True,
    accept: Accept = None,
    json: Annotated[str, typer.Option(help="counts and accuracy as JSON; - prints only JSON")] = "",
    force: Force = False,
    quiet: Quiet = False,
) -> None:
    """Match oriented images to a cloud with the σ of every point, and report its accuracy."""
    import jaxbundle
    from jaxbundle.cli.acceptance import accept_result, check_accept, end_unmet
    from jaxbundle.cli.outputs import check_file, check_json, put_json
    from jaxbundle.cli.progress import staging
    from jaxbundle.io.results.result_json import json_text
    from jaxbundle.io.text.csv_tables import write_text
    from jaxbundle.io.writing.fingerprints import input_files
    from jaxbundle.io.writing.folders import check_folder, replace_folder
    from jaxbundle.report.page import stamp
    from jaxbundle.surfaces.dsm import write_dsm
    from jaxbundle.surfaces.files import write_cloud_csv
    from jaxbundle.surfaces.orthophoto import write_orthophoto
    from jaxbundle.surfaces.point_files import write_cloud
    from jaxbundle.system.clock import in_words, now

    check_accept(accept, "surface")
    check_folder(out, "surface", FILES, input, force)
    given = (file for source in input for file in input_files(source))
    beside = (file for file in (check, geoid) if file is not None)
    check_file("--json", json, out, [*given, *beside])
    check_json(json)
    with staging(quiet or json == "-") as show:
        result = jaxbundle.surface(
            input,
            photos=photos,
            pairs=pairs,
            zmin=zmin,
            zmax=zmax,
            points=points,
            step=step,
            dense=dense,
            dsm=dsm,
            orthophoto=orthophoto,
            orthophoto_of=orthophoto_of,
            check=check,
            crs=crs,
            geoid=geoid,
            heights=heights,
            progress=show,
            tell=lambda message: typer.echo(f"jaxbundle: {message}", err=True),
        )
    files = [str(file) for source in input for file in input_files(source)]
    report_text = f"{', '.join(stamp(files, in_words(now())))}\n{result.report()}"
    acceptance, document = accept_result(result, accept), result.to_dict()
    if acceptance is not None:
        report_text += f"\n\n{acceptance}"
        document = {**document, "acceptance": acceptance.to_dict()}
    with replace_folder(out, "surface", FILES, force) as folder:
        if csv:
            write_cloud_csv(result.cloud, folder / "cloud.csv")
        write_cloud(result.cloud, folder / "cloud.ply")
        if result.dsm is not None:
            write_dsm(result.dsm, folder / "dsm.tif", folder / "dsm_sigma.tif")
            if result.orthophoto is not None:
                write_orthophoto(result.orthophoto, result.dsm, folder / "orthophoto.tif")
        write_text(folder / "surface.json", json_text(document))
        write_text(folder / "report.txt", report_text + "\n")
    if json:
        put_json(json, document)
    if not quiet and json != "-":
        print(report_text)
    end_unmet(acceptance)
