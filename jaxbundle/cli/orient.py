"""`jaxbundle orient`: start values of a network."""

from pathlib import Path
from typing import Annotated

import typer

import jaxbundle
from jaxbundle.cli.app import Control, Force, Format, Input, Quiet, Settings, app
from jaxbundle.cli.common_options import is_in_file


@app.command(example="examples/convergent4/project.toml --out out/oriented", once=True)
def orient(
    input: Input,
    out: Annotated[
        Path | None, typer.Option(help="folder for the project with start values")
    ] = None,
    force: Force = False,
    set: Settings = None,
    format: Format = None,
    control: Control = None,
    quiet: Quiet = False,
) -> None:
    """Compute start values of images and points; list what cannot be oriented, with reasons."""
    from jaxbundle.cli.outputs import network_files
    from jaxbundle.io import read_network, write_project
    from jaxbundle.io.networks.project import FILES
    from jaxbundle.io.writing.folders import check_folder

    network = read_network(input, format=format, overrides=tuple(set or ()), control=control)
    if out is not None:
        check_folder(out, "orient", FILES, network_files(input, network, control), force)
    orientation = jaxbundle.orient(network)
    path = (
        None if out is None else write_project(orientation.network, out, force=force, by="orient")
    )
    if not (quiet and is_in_file(out)):
        print(orientation)
        if path is not None:
            print(path)
