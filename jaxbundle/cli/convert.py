"""`jaxbundle convert`: one format into another."""

from pathlib import Path
from typing import Annotated

import typer

from jaxbundle.cli.app import Format, Input, Settings, app
from jaxbundle.io import read_network, write_project


@app.command()
def convert(
    input: Input,
    output: Annotated[Path, typer.Argument(help="folder of the project to write")],
    set: Settings = None,
    format: Format = None,
) -> None:
    """Write any input as a project: project.toml and CSV tables."""
    path = write_project(read_network(input, format, tuple(set or ())), output)
    print(path)
