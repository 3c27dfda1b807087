"""The board that the options of a command name."""

import re

from jaxbundle.errors import InputError
from jaxbundle.io.boards.targets import read_target
from jaxbundle.measure.boards import Board


def board_given(
    board: str,
    square: str,
    kind: str,
    diameter: float | None,
    marker: float | None,
    dictionary: str,
    first_marker: int = 0,
) -> Board:
    """The board, or the target, that the options name."""
    if board.endswith((".yaml", ".yml")):
        if square:
            raise InputError(f"--square: {board} gives the size of the board; omit it")
        return read_target(board)
    if not board:
        raise InputError("--board is missing: COLUMNSxROWS, inner corners of a chessboard, as 9x6")
    columns, rows = _size(board)
    if not square:
        raise InputError("--square is missing: the side of a square, or the spacing of circles")
    column_spacing, row_spacing = _spacing(square)
    circles = ("circles", "asymmetric-circles")
    for value, option, kinds in (
        (diameter, "--diameter", circles),
        (marker, "--marker", ("charuco", "aprilgrid")),
    ):
        if value is not None and kind not in kinds:
            raise InputError(f"{option} is not for --kind {kind}, but for {' and '.join(kinds)}")
    if first_marker and kind not in ("charuco", "aprilgrid"):
        raise InputError(f"--first-marker is not for --kind {kind}, but for charuco and aprilgrid")
    return Board(
        columns, rows, column_spacing, kind, diameter, marker, dictionary, row_spacing, first_marker
    )


def _size(text: str) -> tuple[int, int]:
    match = re.fullmatch(r"\s*(\d{1,4})\s*[x×X,]\s*(\d{1,4})\s*", text)
    if not match:
        raise InputError(f"--board {text!r}: expected COLUMNSxROWS, such as 9x6")
    return int(match[1]), int(match[2])


def _spacing(text: str) -> tuple[float, float | None]:
    """The side of a square; or the distances of columns and of rows, if two are given."""
    try:
        sides = [float(part) for part in text.split(",")]
    except ValueError:
        sides = []
    if len(sides) not in (1, 2):
        raise InputError(
            f"--square {text!r}: expected a length, such as 0.03, or two if a print has stretched "
            "the board: distance of columns, distance of rows, such as 30.0,30.2"
        )
    return sides[0], sides[1] if len(sides) == 2 else None
