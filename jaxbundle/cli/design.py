"""`jaxbundle design`: stations, photographs or a datum that minimise σ."""

import sys
from pathlib import Path
from typing import Annotated

import typer

import jaxbundle
from jaxbundle.choices import AIMS, DESIGNED, ORDERS
from jaxbundle.cli.app import Force, Json, Quiet, app, choice
from jaxbundle.cli.common_options import is_in_file

BOX_FORM = "Xmin,Ymin,Zmin,Xmax,Ymax,Zmax"


@app.command(example="PROJECT.toml --distance 1,6 --out out/designed")
def design(  # noqa: PLR0913 - the options of the command
    project: Annotated[Path, typer.Argument(help="cameras, targets and start stations")],
    aim: Annotated[str, choice(AIMS, "quantity to minimise")] = "mean",
    of: Annotated[
        list[str] | None,
        typer.Option(
            help="σ of points, cameras, or of an unknown KIND:ID:NAME, such as "
            "camera:cam:c; repeatable"
        ),
    ] = None,
    order: Annotated[
        str, choice(ORDERS, "datum, configuration, weights or densification")
    ] = "first",
    free: Annotated[
        str, typer.Option(help=f"first order: variables, from {','.join(DESIGNED)}")
    ] = ",".join(DESIGNED[:3]),
    stations: Annotated[str, typer.Option(help="ids of movable images, A,B; default: all")] = "",
    photographs: Annotated[
        int | None, typer.Option(help="second order: number to select; third: number to add")
    ] = None,
    sigma_image: Annotated[
        float | None, typer.Option(help="σ of image coordinates, in the unit of the cameras")
    ] = None,
    room: Annotated[str, typer.Option(help=f"allowed camera positions: {BOX_FORM}")] = "",
    distance: Annotated[str, typer.Option(help="shortest,longest ray")] = "",
    focus: Annotated[str, typer.Option(help="smallest,largest depth in focus")] = "",
    edge: Annotated[float, typer.Option(help="unused margin of the format, each side")] = 0.0,
    incidence: Annotated[
        float | None, typer.Option(help="largest angle between normal and ray, degrees")
    ] = None,
    normals: Annotated[
        str, typer.Option(help="of the targets: NX,NY,NZ, or a table id,NX,NY,NZ")
    ] = "",
    apart: Annotated[float, typer.Option(help="smallest distance between stations")] = 0.0,
    obstacle: Annotated[
        list[str] | None, typer.Option(help=f"an opaque box: {BOX_FORM}; repeatable")
    ] = None,
    targets: Annotated[str, typer.Option(help=f"box for movable targets: {BOX_FORM}")] = "",
    starts: Annotated[int, typer.Option(help="searches, all but one from random stations")] = 1,
    max_iterations: Annotated[
        int,
        typer.Option("--max-iterations", "--iterations", min=1, help="per round of the search"),
    ] = 60,
    draws: Annotated[
        int, typer.Option(help="networks simulated and adjusted for verification; 0: none")
    ] = 200,
    seed: Annotated[int, typer.Option(min=0, help="random seed")] = 0,
    out: Annotated[
        Path | None, typer.Option(help="folder: designed project, report, JSON, figures")
    ] = None,
    json: Json = "",
    plots: Annotated[bool, typer.Option(help="write figures to --out")] = True,
    force: Force = False,
    quiet: Quiet = False,
) -> None:
    """Design a network: optimal stations, or a selection of photographs."""
    import numpy as np

    from jaxbundle.cli.camera_inputs import pair
    from jaxbundle.cli.design_files import FILES, fill_design
    from jaxbundle.cli.design_options import box_of, normals_of, parse_aim, words_of
    from jaxbundle.cli.outputs import can_plot, check_writable, network_files, write_result
    from jaxbundle.cli.progress import staging
    from jaxbundle.io.formats import read_oriented
    from jaxbundle.io.results.result_json import json_text
    from jaxbundle.network_design.aims import Aim
    from jaxbundle.network_design.conditions import Conditions
    from jaxbundle.network_design.design_json import design_dict
    from jaxbundle.types import not_none

    network = read_oriented(project)
    check_writable(json, out, "design", FILES, network_files(project, network), force)
    conditions = Conditions(
        room=box_of("--room", room),
        distance=pair("--distance", distance),
        focus=pair("--focus", focus),
        edge=edge,
        incidence=None if incidence is None else np.radians(incidence),
        normals=normals_of(normals, network),
        apart=apart,
        obstacles=tuple(not_none(box_of("--obstacle", text)) for text in obstacle or ()),
        targets=box_of("--targets", targets),
    )
    designed = jaxbundle.design(
        project,
        Aim(aim, parse_aim(of)),
        order=order,
        conditions=conditions,
        free=words_of(free),
        stations=words_of(stations) if stations else None,
        photographs=photographs,
        sigma_image=sigma_image,
        starts=starts,
        max_iterations=max_iterations,
        seed=seed,
    )
    proof = designed.prove(draws, seed) if draws else None
    report = f"{designed}\n" + (f"proof: {proof}\n" if proof else "")
    text = json_text(design_dict(designed, proof))
    with write_result(json, text, out, "design", FILES, force) as folder:
        if folder is not None:
            with staging(quiet or json == "-") as show:
                fill_design(folder, designed, report, text, plots and can_plot(), show)
    if json != "-" and not (quiet and is_in_file(json, out)):
        sys.stdout.write(report)
