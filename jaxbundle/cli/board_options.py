"""The board that the options of a command name."""

import re

from jaxbundle.errors import InputError
from jaxbundle.io.boards.targets import read_target
from jaxbundle.measure.boards import Board


def board_given(
    board: str,
    square: float | None,
    kind: str,
    diameter: float | None,
    marker: float | None,
    dictionary: str,
):
    """The board, or the target, that the options name."""
    if board.endswith((".yaml", ".yml")):
        if square is not None:
            raise InputError(f"--square: {board} gives the size of the board; omit it")
        return read_target(board)
    if not board:
        raise InputError("--board is missing: COLUMNSxROWS, inner corners of a chessboard, as 9x6")
    columns, rows = _size(board)
    if square is None:
        raise InputError("--square is missing: the side of a square, or the spacing of circles")
    circles = ("circles", "asymmetric-circles")
    for value, option, kinds in (
        (diameter, "--diameter", circles),
        (marker, "--marker", ("charuco", "aprilgrid")),
    ):
        if value is not None and kind not in kinds:
            raise InputError(f"{option} is not for --kind {kind}, but for {' and '.join(kinds)}")
    return Board(columns, rows, square, kind, diameter, marker, dictionary)


def _size(text: str) -> tuple[int, int]:
    found = re.fullmatch(r"\s*(\d{1,4})\s*[x×X,]\s*(\d{1,4})\s*", text)
    if not found:
        raise InputError(f"--board {text!r}: COLUMNSxROWS is expected, such as 9x6")
    return int(found[1]), int(found[2])
