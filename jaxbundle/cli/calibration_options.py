"""Options that the commands for calibrations have in common."""

from typing import Annotated

import typer

from jaxbundle.choices import BOARDS, DICTIONARIES, ESTIMATORS, TESTS
from jaxbundle.cli.app import choice, model_choice

Square = Annotated[
    str,
    typer.Option(
        metavar="S or S,S",
        help="side of a square, spacing of circles, in --unit; "
        "two of a stretched print: of columns, of rows",
    ),
]
Kind = Annotated[str, choice(BOARDS)]
Model = Annotated[str, model_choice("camera model")]
Free = Annotated[str, typer.Option(help="parameters to estimate: fx,fy,…")]
Given = Annotated[
    list[str] | None, typer.Option(help="NAME=VALUE of a parameter; held if not free")
]
PixelSize = Annotated[float | None, typer.Option(help="mm, for models in mm")]
Diameter = Annotated[
    float | None, typer.Option(help="of the circles, to correct their eccentricity")
]
Marker = Annotated[float | None, typer.Option(help="side of a marker or tag")]
Dictionary = Annotated[str, choice(DICTIONARIES, "of markers or tags")]
FirstMarker = Annotated[
    int, typer.Option(min=0, help="number of the first marker or tag of the board")
]
BoardSigma = Annotated[
    float | None, typer.Option(help="σ of a board coordinate, for an inexact board")
]
BoardFree = Annotated[bool, typer.Option("--board-free", help="estimate the points of the board")]
SigmaImage = Annotated[
    float | None,
    typer.Option(
        help="a priori σ of an image coordinate, pixels; default: 0.1 as a unit "
        "of weight, without a χ² test"
    ),
]
Snooping = Annotated[str, choice((*TESTS, "none"), "removal of gross errors and of rig epochs")]
Significance = Annotated[float, typer.Option(help="level of the test")]
Robust = Annotated[str | None, choice(ESTIMATORS, "instead of removal")]
CrossValidation = Annotated[
    bool, typer.Option(help="calibrate from each half of the photographs: 4 adjustments")
]
Unit = Annotated[str, typer.Option(help="unit of the board: m, mm, in, …")]
Brief = Annotated[bool, typer.Option("--brief", help="omit points and residuals from the JSON")]
Plots = Annotated[bool, typer.Option(help="write plots to --out")]
