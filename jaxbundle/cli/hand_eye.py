"""`jaxbundle hand-eye`: a camera on the hand of a robot, or before it."""

from pathlib import Path
from typing import Annotated

import typer

from jaxbundle.choices import HAND_EYE
from jaxbundle.cli import calibration_options as options
from jaxbundle.cli.app import Json, app, choice
from jaxbundle.cli.certificate_options import Accept
from jaxbundle.errors import InputError

KIND, DICTIONARY, MODEL = "chessboard", "DICT_4X4_50", "opencv"


@app.command("hand-eye", example="photos --poses robot.csv --board 9x6 --square 0.03")
def hand_eye_command(  # noqa: PLR0913 - the options of the command
    input: Annotated[
        list[str],
        typer.Argument(help="a project or another network; or, with --board, photographs"),
    ],
    poses: Annotated[
        Path,
        typer.Option(
            help="table image,X,Y,Z,qw,qx,qy,qz (or rx,ry,rz; roll,pitch,yaw) of the hand"
        ),
    ],
    type: Annotated[str, choice(HAND_EYE, "where the camera is")] = HAND_EYE[0],
    sigma_position: Annotated[
        float | None, typer.Option(help="repeatability of the robot, object unit")
    ] = None,
    sigma_angle: Annotated[float | None, typer.Option(help="of its attitude, --angle-unit")] = None,
    angle_unit: Annotated[
        str | None,
        typer.Option(help="of poses and results: deg, rad, gon; default: the project's, else deg"),
    ] = None,
    board: Annotated[str, typer.Option(help="COLUMNSxROWS: inner corners of a board")] = "",
    square: options.Square = "",
    kind: options.Kind = KIND,
    marker: options.Marker = None,
    dictionary: options.Dictionary = DICTIONARY,
    model: options.Model = MODEL,
    accept: Accept = None,
    json: Json = "",
) -> None:
    """Find the pose of a camera on a robot, with σ, from photographs and the robot's poses."""
    import jaxbundle
    from jaxbundle.cli.acceptance import check_accept
    from jaxbundle.cli.board_options import board_given
    from jaxbundle.cli.outputs import check_json_target, print_result

    check_accept(accept, "hand-eye")
    check_json_target(json, [*input, str(poses)])
    settings = {
        "type": type,
        "sigma_position": sigma_position,
        "sigma_angle": sigma_angle,
        "angle_unit": angle_unit,
    }
    if board:
        board_of_photographs = board_given(board, square, kind, None, marker, dictionary)
        result = jaxbundle.hand_eye(
            input, poses, board=board_of_photographs, model=model, **settings
        )
    else:
        _refuse_board_options(
            square=square != "",
            kind=kind != KIND,
            marker=marker is not None,
            dictionary=dictionary != DICTIONARY,
            model=model != MODEL,
        )
        network = input[0] if len(input) == 1 else input
        result = jaxbundle.hand_eye(network, poses, **settings)
    print_result(result, json, accept=accept)


def _refuse_board_options(**is_given: bool) -> None:
    """Refuse options of a board where there is none: the network has its camera and its points."""
    for option, given in is_given.items():
        if given:
            raise InputError(f"--{option}: it is for photographs of a board; give --board, too")
