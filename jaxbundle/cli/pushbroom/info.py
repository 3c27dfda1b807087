"""`jaxbundle pushbroom info`: what a file says of its image."""

import json as json_text
from pathlib import Path

import typer

from jaxbundle.cli.pushbroom.app import ImageFile, Json, Level, pushbroom


@pushbroom.command(example="out/flight/scanner.toml")
def info(scanner: ImageFile, height: Level = None, json: Json = "") -> None:
    """Size, ground sampling, view, footprint, corrections; agreement with the RPC of a product."""
    from jaxbundle import pushbroom as line_scanners
    from jaxbundle.cli.pushbroom.shared import keep_inputs, warn
    from jaxbundle.io.text.csv_tables import write_text
    from jaxbundle.system.terminals import write_json

    keep_inputs([scanner], json=json)
    found = line_scanners.info(scanner, height=height, tell=warn)
    text = json_text.dumps(found.to_dict(), ensure_ascii=False) + "\n"
    if json == "-":
        write_json(text)
        return
    if json:
        write_text(Path(json), text)
    typer.echo(str(found))
