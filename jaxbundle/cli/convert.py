"""`jaxbundle convert`: convert between formats."""

import dataclasses
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer

from jaxbundle.choices import CAMERA_FILES, CAMERA_INPUTS, NETWORK_FILES, TARGETS
from jaxbundle.cli.app import Control, Format, Input, Quiet, Settings, app, choice, model_choice
from jaxbundle.errors import InputError


@app.command(
    example="examples/convergent4/project.toml out/network.ply",
    once=True,
    accepts=CAMERA_INPUTS | NETWORK_FILES,
)
def convert(  # noqa: PLR0913 - the options of the command
    input: Input,
    output: Annotated[Path, typer.Argument(help="file or folder to write")],
    to: Annotated[
        str | None,
        choice((*TARGETS, *CAMERA_FILES), "output format, if not recognised by its name"),
    ] = None,
    model: Annotated[str | None, model_choice("camera model to convert to")] = None,
    camera: Annotated[
        str | None, typer.Option(help="camera id, for an output of one camera")
    ] = None,
    measured: Annotated[
        bool, typer.Option("--measured", help="fit models over the measured area, not the image")
    ] = False,
    image_size: Annotated[str, typer.Option(help="W,H in pixels, if missing in the input")] = "",
    pixel_size: Annotated[str, typer.Option(help="W,H in mm, if missing in the input")] = "",
    force: Annotated[
        bool, typer.Option("--force", help="replace existing or foreign files")
    ] = False,
    set: Settings = None,
    format: Format = None,
    control: Control = None,
    quiet: Quiet = False,
) -> None:
    """Write any input in another format: project, COLMAP, BAL, Bundler, OpenCV, PLY, DXF, CSV."""
    from jaxbundle.cli.camera_inputs import pair
    from jaxbundle.io.exchange import convert as convert_file
    from jaxbundle.io.exchange import describe_lost

    overrides = tuple(set or ())
    size = pair("--image-size", image_size)
    if size is not None and not all(number.is_integer() for number in size):
        raise InputError(f"--image-size {image_size}: expected whole numbers of pixels")
    losses_told: list[str] = []

    def tell(losses: Sequence[str]) -> None:
        losses_told.extend(losses)
        for line in () if quiet else describe_lost(losses):
            print(f"warning: {line}", file=sys.stderr, flush=True)

    conversion = convert_file(
        input,
        output,
        to=to,
        model=model,
        camera=camera,
        format=format,
        overrides=overrides,
        measured=measured,
        image_size=size and tuple(map(int, size)),
        pixel_size=pair("--pixel-size", pixel_size),
        force=force,
        control=control,
        tell=tell,
    )
    if not quiet:
        # Only what the writer has found beside.
        conversion = dataclasses.replace(
            conversion, lost=tuple(loss for loss in conversion.lost if loss not in losses_told)
        )
        print(str(conversion).split("\n", 1)[0])
        for line in str(conversion).splitlines()[1:]:
            print(line, file=sys.stderr if line.startswith("warning") else sys.stdout)
