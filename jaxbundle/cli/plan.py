"""`jaxbundle plan`: plan an aerial block."""

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer

from jaxbundle.cli.app import Force, Json, app
from jaxbundle.cli.certificate_options import Accept
from jaxbundle.errors import InputError


@app.command(example="--c 100 --image 68,104 --area 1000,600 --sigma-image 0.003 --height 1000")
def plan(  # noqa: PLR0913 - the options of the command
    c: Annotated[float, typer.Option(help="principal distance, mm")],
    image: Annotated[str, typer.Option(help="format along,across the flight, mm")],
    area: Annotated[str, typer.Option(help="length,width of the area, m")],
    sigma_image: Annotated[float, typer.Option(help="σ of an image coordinate, mm")],
    height: Annotated[float | None, typer.Option(help="flying height above ground, m")] = None,
    scale: Annotated[float | None, typer.Option(help="scale number m of 1 : m")] = None,
    ground_pixel: Annotated[float | None, typer.Option(help="ground pixel size, m")] = None,
    pixel: Annotated[float | None, typer.Option(help="pixel size, mm")] = None,
    forward: Annotated[float, typer.Option(help="forward overlap")] = 0.6,
    side: Annotated[float, typer.Option(help="side overlap")] = 0.3,
    control_sigma: Annotated[float, typer.Option(help="σ of control points, m")] = 0.05,
    control_every: Annotated[
        int | None,
        typer.Option(help="bases and strips between control points; default: nine in all"),
    ] = None,
    errors: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME=SIZE",
            help="errors that image points share, mm, by name as adjust lists them, such as "
            "'principal point by photograph=0.001'; repeatable",
        ),
    ] = None,
    network: Annotated[
        bool, typer.Option(help="σ from the covariance of a simulated block")
    ] = True,
    out: Annotated[Path | None, typer.Option(help="folder for the block as a project")] = None,
    accept: Accept = None,
    json: Json = "",
    force: Force = False,
) -> None:
    """Plan a block of vertical photographs: strips, photographs, expected precision."""
    import jaxbundle
    from jaxbundle.cli.acceptance import check_accept
    from jaxbundle.cli.outputs import check_writable, print_result
    from jaxbundle.io import write_project
    from jaxbundle.io.networks.project import FILES

    check_accept(accept, "plan")
    check_writable(json, out, "plan", FILES, (), force)
    if sum(value is not None for value in (height, scale, ground_pixel)) != 1:
        raise InputError("give one of --height, --scale, --ground-pixel (with --pixel)")
    planned = jaxbundle.plan(
        c,
        _require_pair("--image", image),
        _require_pair("--area", area),
        sigma_image,
        height=height,
        scale=scale,
        ground_pixel=ground_pixel,
        pixel=pixel,
        forward=forward,
        side=side,
        control_sigma=control_sigma,
        control_every=control_every,
        network=network,
        errors=_sizes(errors or ()),
    )
    if out is not None:
        project_file = write_project(planned.network, out, force=force, by="plan")
        if json != "-":
            print(f"{'written':22}{project_file}")
    print_result(planned, json, accept=accept)


def _sizes(assignments: Sequence[str]) -> dict[str, float]:
    """The sizes of error components, by name."""
    sizes = {}
    for text in assignments:
        name, mark, size = text.rpartition("=")
        try:
            sizes[name.strip()] = float(size)
        except ValueError:
            mark = ""
        if not mark:
            raise InputError(f"--errors {text!r}: expected NAME=SIZE, a size in mm")
    return sizes


def _require_pair(option: str, text: str) -> tuple[float, float]:
    from jaxbundle.cli.camera_inputs import pair

    numbers = pair(option, text)
    if numbers is None:
        raise InputError(f"{option}: expected two numbers A,B")
    return numbers
