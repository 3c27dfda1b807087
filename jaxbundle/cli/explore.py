"""`jaxbundle explore`: a network, a camera or a line scanner on a page that computes."""

from pathlib import Path
from typing import Annotated

import typer

from jaxbundle.choices import EXPLORED
from jaxbundle.cli.app import Control, Format, Quiet, Settings, app, choice


@app.command(example="examples/convergent4/project.toml")
def explore(
    input: Annotated[
        str, typer.Argument(help="network; camera (FILE or FILE#ID, result of calibrate); scanner "
                            "or flight file")
    ],
    kind: Annotated[
        str | None, choice(EXPLORED, "what INPUT is, if it is not recognised", "--as")
    ] = None,
    photo: Annotated[Path | None, typer.Option(help="photograph to undistort by a camera")] = None,
    image_size: Annotated[str, typer.Option(help="W,H in pixels, if a camera has none")] = "",
    pixel_size: Annotated[str, typer.Option(help="W,H in mm, if a camera has none")] = "",
    truth: Annotated[Path | None, typer.Option(help="scanner file of the truth")] = None,
    set: Settings = None,
    format: Format = None,
    control: Control = None,
    port: Annotated[int, typer.Option(min=0, max=65535, help="0: any that is free")] = 0,
    browser: Annotated[bool, typer.Option(help="open the page in a browser")] = True,
    quiet: Quiet = False,
) -> None:
    """Explore a network, a camera or a line scanner on a page that computes.

    The page is at an address of this machine alone, which the terminal shows. Ctrl-C ends it.
    """
    import webbrowser

    from jaxbundle.cli.explore_given import open_view
    from jaxbundle.explore.server import Server

    view = open_view(
        input, kind, photo=photo, sizes=(image_size, pixel_size), truth=truth, settings=set or (),
        format=format, control=control, quiet=quiet,
    )  # fmt: skip
    tell = lambda line: typer.echo(f"jaxbundle: {line}", err=True)
    server = Server(view, port, tell)
    print(server.address, flush=True)
    if not quiet:
        tell("the first change compiles programs, once for this size; Ctrl-C ends")
    if browser:
        webbrowser.open(server.address)
    server.serve_forever()
