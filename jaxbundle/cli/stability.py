"""`jaxbundle stability`: calibrations of one camera at several epochs."""

from json import dumps
from typing import Annotated

import typer

from jaxbundle.cli.app import app


@app.command(example="spring.json summer.json autumn.json --at 8,24,13")
def stability(
    files: Annotated[
        list[str], typer.Argument(help="results (JSON) of calibrate or adjust, FILE or FILE#ID")
    ],
    at: Annotated[
        str, typer.Option(help="a,b,c: a number or date per epoch, such as temperature, for slopes")
    ] = "",
    json: Annotated[str, typer.Option(help="write the result as JSON; - prints only JSON")] = "",
) -> None:
    """Test whether calibrations of one camera differ significantly."""
    from pathlib import Path

    import jaxbundle
    from jaxbundle.cli.camera_inputs import calibration_given
    from jaxbundle.io.text.csv_tables import write_text
    from jaxbundle.system.terminals import write_json

    for file in files:
        calibration_given(file)  # its warnings
    words = [word.strip() for word in at.split(",")] if at else None
    found = jaxbundle.stability(files, at=words)
    text = dumps(found.to_dict(), indent=1) + "\n"
    if json == "-":
        write_json(text)
        return
    if json:
        write_text(Path(json), text)
    print(found.report())
