"""`jaxbundle stability`: calibrations of one camera at several epochs."""

from typing import Annotated

import typer

from jaxbundle.cli.app import Json, app
from jaxbundle.cli.certificate_options import Accept


@app.command(example="spring.json summer.json autumn.json --at 8,24,13")
def stability(
    files: Annotated[
        list[str], typer.Argument(help="results (JSON) of calibrate or adjust, FILE or FILE#ID")
    ],
    at: Annotated[
        str, typer.Option(help="a,b,c: a number or date per epoch, such as temperature, for slopes")
    ] = "",
    accept: Accept = None,
    json: Json = "",
) -> None:
    """Test whether calibrations of one camera differ significantly."""
    import jaxbundle
    from jaxbundle.cli.acceptance import check_accept
    from jaxbundle.cli.camera_inputs import calibration_given
    from jaxbundle.cli.outputs import check_json_target, print_result

    check_accept(accept, "stability")
    check_json_target(json, (file.partition("#")[0] for file in files))
    for file in files:
        calibration_given(file)  # its warnings
    words = [word.strip() for word in at.split(",")] if at else None
    print_result(jaxbundle.stability(files, at=words), json, accept=accept)
