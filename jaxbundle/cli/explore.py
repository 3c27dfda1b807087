"""`jaxbundle explore`: a network, a camera or a line scanner on an interactive page."""

from pathlib import Path
from typing import Annotated

import typer

from jaxbundle.choices import EXPLORED
from jaxbundle.cli.app import Control, Format, Quiet, Settings, app, choice


@app.command(example="examples/convergent4/project.toml")
def explore(  # noqa: PLR0913 - the options of the command
    input: Annotated[
        str,
        typer.Argument(
            help="network; camera (FILE or FILE#ID, result of calibrate); scanner or flight file"
        ),
    ],
    kind: Annotated[
        str | None, choice(EXPLORED, "type of INPUT, if not recognised", "--as")
    ] = None,
    photo: Annotated[
        Path | None, typer.Option(help="photograph to undistort, for a camera")
    ] = None,
    image_size: Annotated[str, typer.Option(help="W,H in pixels, if missing in the camera")] = "",
    pixel_size: Annotated[str, typer.Option(help="W,H in mm, if missing in the camera")] = "",
    truth: Annotated[Path | None, typer.Option(help="scanner file of the truth")] = None,
    scene: Annotated[
        Path | None, typer.Option(help="georeferenced raster for the pictures of a scanner")
    ] = None,
    set: Settings = None,
    format: Format = None,
    control: Control = None,
    correlated: Annotated[
        bool,
        typer.Option("--correlated", help="look for errors that image points share; σ under them"),
    ] = False,
    port: Annotated[int, typer.Option(min=0, max=65535, help="0: any that is free")] = 0,
    browser: Annotated[bool, typer.Option(help="open the page in a browser")] = True,
    quiet: Quiet = False,
) -> None:
    """Explore a network, a camera or a line scanner on an interactive page.

    The page is served on this machine only; the terminal shows its address. Ctrl-C ends it.
    """
    import webbrowser

    import jaxbundle
    from jaxbundle.cli.camera_inputs import pair
    from jaxbundle.cli.progress import iterating

    tell = lambda line: typer.echo(f"jaxbundle: {line}", err=True)
    with iterating(quiet) as progress:
        server = jaxbundle.explore(
            input,
            kind=kind,
            photo=photo,
            image_size=pair("--image-size", image_size),
            pixel_size=pair("--pixel-size", pixel_size),
            truth=truth,
            scene=scene,
            overrides=tuple(set or ()),
            format=format,
            control=control,
            correlated=correlated,
            port=port,
            progress=progress,
            tell=tell,
        )
    print(server.address, flush=True)
    if not quiet:
        tell("programs are compiled once per size; Ctrl-C ends")
    if browser:
        webbrowser.open(server.address)
    server.serve_forever()
