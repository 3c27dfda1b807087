"""`jaxbundle example`: the packaged examples."""

from pathlib import Path
from typing import Annotated

import typer

import jaxbundle
from jaxbundle.cli.app import app
from jaxbundle.errors import InputError
from jaxbundle.system.examples import EXAMPLES


@app.command(example="convergent4 first")
def example(
    name: Annotated[str, typer.Argument(help=", ".join(EXAMPLES))] = "",
    folder: Annotated[Path | None, typer.Argument(help="new or empty folder")] = None,
) -> None:
    """Write an example into a folder; without a name, list the examples."""
    if not name:
        for example_name, (about, _) in EXAMPLES.items():
            print(f"{example_name:14} {about}")
        return
    if folder is None:
        raise InputError(f"FOLDER is missing: jaxbundle example {name} {name}")
    jaxbundle.example(name, folder)
    print(f"{folder}: {EXAMPLES[name].about}")
    print(f"next: {EXAMPLES[name].command.replace('FOLDER', str(folder))}")
