"""`jaxbundle orient`: the start values of a network."""

from pathlib import Path
from typing import Annotated

import typer

import jaxbundle
from jaxbundle.cli.app import Format, Input, Quiet, Settings, app
from jaxbundle.io import read_network, write_project


@app.command()
def orient(
    input: Input,
    out: Annotated[
        Path | None, typer.Option(help="folder for the project with start values")
    ] = None,
    set: Settings = None,
    format: Format = None,
    quiet: Quiet = False,
) -> None:
    """Find the start values of images and points; what cannot be placed is named, with why."""
    jaxbundle.enable_x64()
    found = jaxbundle.orient(read_network(input, format, tuple(set or ())))
    path = None if out is None else write_project(found.network, out)
    if not quiet:
        print(found)
        if path is not None:
            print(path)
