"""`jaxbundle reconstruct`: photographs to an adjusted network."""

from contextlib import nullcontext
from pathlib import Path
from typing import Annotated

import typer

from jaxbundle.choices import ANGLE_UNIT_NAMES, CODED_TARGETS, MATCHED_PAIRS, TIE_POINTS
from jaxbundle.cli.app import (
    NOT_SOLVED,
    Check,
    Correlated,
    Force,
    Html,
    Json,
    Quiet,
    app,
    choice,
)
from jaxbundle.cli.certificate_options import (
    Accept,
    CertificateFile,
    CertificateOptions,
    Details,
    Lengths,
)
from jaxbundle.cli.gis_output import Crs, Gis, check_gis, write_gis
from jaxbundle.cli.judging import judge_of
from jaxbundle.errors import InputError
from jaxbundle.system.interrupts import advise


@app.command(name="reconstruct", example="PHOTOS --control gcp_list.txt --out out/block")
def reconstruct_command(  # noqa: PLR0913 - the options of the command
    photos: Annotated[list[Path], typer.Argument(help="photographs, or folders of them")],
    out: Annotated[Path, typer.Option(help="folder for report, page, JSON, tables, COLMAP model")],
    camera: Annotated[
        str | None,
        typer.Option(help="calibrated camera of all photographs: FILE or FILE#ID; held fixed"),
    ] = None,
    control: Annotated[
        Path | None,
        typer.Option(help="control points: gcp_list.txt, or a table, with or without measurements"),
    ] = None,
    control_sigma: Annotated[
        str | None,
        typer.Option(
            metavar="SIGMA[,HEIGHT]",
            help="σ of control points without their own, metres; default: estimated",
        ),
    ] = None,
    check: Check = None,
    name: Annotated[str, typer.Option(help="name of the job; default: the folder")] = "",
    targets: Annotated[
        str | None,
        typer.Option(help=f"coded targets: {', '.join(CODED_TARGETS)}; :OPTION after it"),
    ] = None,
    uncoded: Annotated[
        bool, typer.Option("--uncoded", help="with ring-coded targets: plain discs, too")
    ] = False,
    distances: Annotated[
        Path | None, typer.Option(help="scale bars: table from,to,value,sigma between named points")
    ] = None,
    features: Annotated[str, choice(TIE_POINTS)] = "sift",
    pairs: Annotated[str, choice(MATCHED_PAIRS, "matched")] = "auto",
    points: Annotated[int, typer.Option(min=20, help="desired tie points per photograph")] = 1500,
    square_pixels: Annotated[
        bool, typer.Option(help="observe fy/fx as 1; otherwise both focal lengths are unknown")
    ] = True,
    camera_per_folder: Annotated[
        bool,
        typer.Option("--camera-per-folder", help="every folder has a camera of its own"),
    ] = False,
    angle_unit: Annotated[str, choice(ANGLE_UNIT_NAMES, "of the results")] = "deg",
    unit: Annotated[
        str,
        typer.Option(
            help="of --distances, and of the results where they give the scale: mm, in, …"
        ),
    ] = "m",
    correlated: Correlated = True,
    json: Json = "",
    html: Html = "",
    accept: Accept = None,
    certificate: CertificateFile = "",
    details: Details = None,
    lengths: Lengths = None,
    gis: Gis = "",
    crs: Crs = "",
    brief: Annotated[
        bool, typer.Option("--brief", help="omit points and residuals from the JSON")
    ] = False,
    surface: Annotated[
        bool, typer.Option("--surface", help="match the oriented photographs to a surface")
    ] = False,
    plots: Annotated[bool, typer.Option(help="write plots to --out")] = True,
    force: Force = False,
    quiet: Quiet = False,
) -> None:
    """Reconstruct a network from photographs: tie points, self-calibration, adjustment."""
    import jaxbundle
    from jaxbundle.cli.camera_inputs import calibration_given
    from jaxbundle.cli.outputs import PAGE, REPORT, check_writable, trace_files
    from jaxbundle.cli.progress import staging
    from jaxbundle.cli.reconstruct_files import COMMAND, FILES, keep_matches, write_reconstruction
    from jaxbundle.commands.reconstruction import open_control
    from jaxbundle.measure.coded_targets import check_kind
    from jaxbundle.reconstruction.named import read_distances
    from jaxbundle.reconstruction.page import conclude_part
    from jaxbundle.reconstruction.photographs import find_photographs

    if surface and not (len(photos) == 1 and photos[0].is_dir()):
        raise InputError("--surface: give one folder of photographs")
    # Read here, before --out becomes this command's: their errors leave nothing behind.
    if targets is not None:
        check_kind(targets)
    opened_camera = None if camera is None else calibration_given(camera)[0]
    opened_control = open_control(control, control_sigma, check or ())
    bars = () if distances is None else read_distances(distances)
    files = [p for p in (*photos, control, distances) if p is not None and p.is_file()]
    # Before the search, which opens every photograph; after it the photographs are inputs, too.
    check_writable(json, out, COMMAND, FILES, files, force)
    check_gis(gis, crs, files, force, system_may_follow=True)
    judged = CertificateOptions(accept, certificate, details, lengths)
    judge = judge_of(
        COMMAND, judged, {"--json": json, "--html": html}, out, files, models=["opencv"]
    )
    photographs, _ = find_photographs(photos)
    check_writable(json, out, COMMAND, FILES, [*files, *(p.path for p in photographs)], force, html)
    # Targets are found again in seconds.
    kept_matches = nullcontext() if features == "none" else keep_matches(out, force)
    with kept_matches as store, staging(quiet or json == "-") as tell:
        if store is not None:
            advise(f"run the same command again to resume; matches are kept in {store}")
        result = jaxbundle.reconstruct(
            photos,
            camera=opened_camera,
            control=opened_control,
            name=name,
            targets=targets,
            uncoded=uncoded,
            distances=bars,
            features=features,
            pairs=pairs,
            points=points,
            square_pixels=square_pixels,
            camera_per_folder=camera_per_folder,
            angle_unit=angle_unit,
            unit=unit,
            correlated=correlated,
            store=store,
            progress=tell,
        )
    origin = trace_files(
        [*files, *(p.path for p in photographs)],
        {
            "--camera": camera,
            "--control-sigma": control_sigma,
            "--check": ", ".join(check or ()),
            "--targets": targets,
            "--uncoded": uncoded,
            "--distances": distances,
            "--features": features,
            "--pairs": pairs,
            "--points": points,
            "--no-square-pixels": True if not square_pixels else None,
            "--camera-per-folder": camera_per_folder,
            "--angle-unit": angle_unit,
            "--unit": unit,
            "--no-correlated": True if not correlated else None,
            **judged.settings,
        },
    )
    judgement = judge.judge(result, origin)
    with staging(quiet or json == "-") as show:
        write_reconstruction(result, json, out, brief, plots, force, html, origin, show, judgement)
        judge.write(judgement)
    if not quiet and json != "-":
        for part in result.parts:
            print(f"{result.prefix(part)}{conclude_part(result, part).words}")
        print(result)
        if judgement is not None:
            print(judgement.text)
        print(f"Report: {out / REPORT}, as a page: {out / PAGE}")
    if surface:
        _surface(out, photos[0], force, quiet)
    # Last: GeoJSON of a frame that turned out to be arbitrary is refused, and all else is there.
    write_gis(result.parts[0].adjustment, gis, crs or result.parts[0].block.epsg)
    judge.end(judgement)
    if reasons := [part.no_control for part in result.parts if part.no_control]:
        # The network is solved, but not where control was to put it: a script has to see that.
        typer.echo(f"jaxbundle: control is not used: {reasons[0]}", err=True)
        raise typer.Exit(NOT_SOLVED)


def _surface(out: Path, photos: Path, force: bool, quiet: bool) -> None:
    from jaxbundle.cli.surface import surface

    surface([out / "network"], out / "surface", photos, force=force, quiet=quiet)
