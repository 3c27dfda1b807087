"""`jaxbundle plan`: plan an aerial block."""

from pathlib import Path
from typing import Annotated

import typer

from jaxbundle.cli.app import Force, app
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
    network: Annotated[
        bool, typer.Option(help="σ from the covariance of a simulated block")
    ] = True,
    out: Annotated[Path | None, typer.Option(help="folder for the block as a project")] = None,
    force: Force = False,
) -> None:
    """Plan a block of vertical photographs: strips, photographs, expected precision."""
    import numpy as np

    from jaxbundle.adjustment.quality.expected_precision import expected_precision
    from jaxbundle.cameras.field_of_view import angle_class, equivalent_35mm, field_of_view
    from jaxbundle.io import write_project
    from jaxbundle.io.networks.project import FILES
    from jaxbundle.io.writing.folders import check_folder
    from jaxbundle.network.tables import Camera
    from jaxbundle.planning.planned_block import planned_network
    from jaxbundle.planning.vertical_photographs import design_block, relief_displacement

    if out is not None:
        check_folder(out, "plan", FILES, force=force)
    image_format, extent = _require_pair("--image", image), _require_pair("--area", area)
    if sum(value is not None for value in (height, scale, ground_pixel)) != 1:
        raise InputError("give one of --height, --scale, --ground-pixel (with --pixel)")
    design = design_block(
        c,
        image_format,
        extent,
        sigma_image,
        height=height,
        scale_number=scale,
        pixel_on_ground=ground_pixel,
        pixel=pixel,
        forward_overlap=forward,
        side_overlap=side,
    )
    view = field_of_view(c, image_format)
    degrees = ", ".join(f"{np.degrees(angle):.2f}°" for angle in view)
    # of 1 % of the flying height, so that other heights follow by proportion
    relief = relief_displacement(image_format[1] / 2, 0.01 * design.height, design.height)
    ground = "" if design.pixel_on_ground is None else f"  pixel {design.pixel_on_ground:.4g} m"
    lines = [
        ("field of view", f"{degrees} (along, across, diagonal): {angle_class(view.diagonal)}"),
        ("35 mm equivalent", f"{equivalent_35mm(c, image_format):.1f} mm"),
        ("flying height", f"{design.height:.6g} m above ground"),
        ("scale", f"1 : {design.scale_number:.6g}{ground}"),
        ("footprint", f"{design.footprint[0]:.6g} × {design.footprint[1]:.6g} m"),
        ("relief displacement", f"{relief:.4g} mm at the edge for 1 % of the flying height"),
        ("base", f"{design.base:.6g} m  b/H {design.base_to_height:.3f}"),
        (
            "strips",
            f"{design.strips}, {design.spacing:.6g} m apart "
            f"(side overlap {100 * design.side_overlap:.1f} %)",
        ),
        ("photographs", f"{design.photographs_per_strip} per strip, {design.photographs} in all"),
        ("σX, σH by formula", f"{design.sigma_plan:.4g} m, {design.sigma_height:.4g} m"),
    ]
    # the orientations of 2000 photographs have a covariance of 12 000 rows, 1.2 GB
    if network and design.photographs > 2000:
        raise InputError(
            f"{design.photographs} photographs: too many for a covariance; give "
            "--no-network, or plan a part of the area"
        )
    if network or out is not None:
        camera = Camera("cam", "brown", {"c": c})
        block = planned_network(
            design, camera, image_format, extent, sigma_image, control_sigma, control_every
        )
        control = sum(role in ("control", "fixed") for role in block.points.role)
        lines.append(("simulated block", f"{len(block.points)} points, {control} of them control"))
        if network:
            found = expected_precision(block)
            for axis, (mean, low, high) in found.summary().items():
                lines.append((f"σ{axis} of tie points", f"{mean:.4g} m ({low:.4g} to {high:.4g})"))
        if out is not None:
            lines.append(("written", str(write_project(block, out, force=force, by="plan"))))
    for name, value in lines:
        print(f"{name:22}{value}")


def _require_pair(option: str, text: str) -> tuple[float, float]:
    from jaxbundle.cli.camera_inputs import pair

    found = pair(option, text)
    if found is None:
        raise InputError(f"{option}: two numbers A,B are expected")
    return found
