"""Boards of Kalibr: the YAML of a target.

    target_type: checkerboard    targetCols, targetRows: inner corners; rowSpacingMeters,
                                 colSpacingMeters
    target_type: circlegrid      targetCols, targetRows, spacingMeters, asymmetricGrid
    target_type: aprilgrid       tagCols, tagRows, tagSize, tagSpacing: gap / tagSize

The spacing of an asymmetric grid is between neighbouring rows, as `Board.square`. Metres.

Source: Kalibr's wiki, "Calibration targets".
"""

from pathlib import Path

from jaxbundle.arguments import show
from jaxbundle.errors import InputError
from jaxbundle.io.text.csv_tables import read_text, write_text
from jaxbundle.io.text.json_fields import JsonFields
from jaxbundle.io.text.yaml_text import parse_yaml
from jaxbundle.measure.boards import Board
from jaxbundle.network.columns import refuse_unknown
from jaxbundle.system.file_content import naming_file

TYPES = ("checkerboard", "circlegrid", "aprilgrid")
# All are geometry: a board has no place for a warning, so that any other key is refused.
KEYS = (
    *("target_type", "targetCols", "targetRows", "rowSpacingMeters", "colSpacingMeters"),
    *("spacingMeters", "asymmetricGrid", "tagCols", "tagRows", "tagSize", "tagSpacing"),
    "codeOffset",
)
CIRCLES = {False: "circles", True: "asymmetric-circles"}


def read_target(path: str | Path) -> Board:
    """The board of a file.

    **Raises:** `InputError` naming file and key.
    """
    with naming_file(path):  # a Board checks its own values
        return _board(path, JsonFields(path, parse_yaml(path, read_text(Path(path)))))


def _board(path: str | Path, fields: JsonFields) -> Board:
    kind = fields.text("target_type")
    for key in fields.document:
        refuse_unknown(key, KEYS, f"{path}: ")
    if fields.integer("codeOffset", 0):
        raise InputError(f"{path}: codeOffset is not 0; expected a board whose first tag is tag 0")
    if kind not in TYPES:
        raise InputError(f"{path}: target_type {kind}: expected {' or '.join(TYPES)}")
    if kind == "aprilgrid":
        columns, rows = (fields.integer(key, minimum=1) for key in ("tagCols", "tagRows"))
        side, gap = fields.number("tagSize"), fields.number("tagSpacing")
        if not gap > 0:
            raise InputError(f"{path}: tagSpacing {gap:g}: expected a positive part of tagSize")
        return Board(columns, rows, side * (1 + gap), kind, marker=side)
    columns, rows = (fields.integer(key, minimum=1) for key in ("targetCols", "targetRows"))
    if kind == "circlegrid":
        asymmetric = fields.get("asymmetricGrid", False)
        if asymmetric not in CIRCLES:
            raise InputError(f"{path}: asymmetricGrid is {show(asymmetric)}; True or False")
        return Board(columns, rows, fields.number("spacingMeters"), CIRCLES[asymmetric])
    rows_apart, columns_apart = fields.number("rowSpacingMeters"), fields.number("colSpacingMeters")
    oblong = None if rows_apart == columns_apart else rows_apart
    return Board(columns, rows, columns_apart, row_spacing=oblong)


def write_target(board: Board, path: str | Path) -> None:
    """Write a board in metres.

    **Raises:** `InputError` for what Kalibr does not have: ChArUco, numbers of tags that do not
    begin at 0, circles and tags with two spacings.
    """
    if board.kind == "charuco":
        raise InputError(f"{path}: Kalibr has no board of kind charuco")
    if board.first_marker:
        raise InputError(
            f"{path}: Kalibr's tags begin at 0, those of the board at {board.first_marker}; write "
            "another format"
        )
    if board.row_spacing not in (None, board.square) and board.kind != "chessboard":
        raise InputError(f"{path}: Kalibr has one spacing for a board of kind {board.kind}")
    if board.kind == "aprilgrid" and board.marker:
        lines = [f"tagCols: {board.columns}", f"tagRows: {board.rows}"]
        gap = board.square / board.marker - 1  # tagSpacing is relative to tagSize
        lines += [f"tagSize: {board.marker!r}", f"tagSpacing: {gap!r}"]
        write_text(Path(path), "\n".join(["target_type: 'aprilgrid'", *lines]) + "\n")
        return
    lines = [f"targetCols: {board.columns}", f"targetRows: {board.rows}"]
    if board.kind == "chessboard":
        lines = [
            "target_type: 'checkerboard'",
            *lines,
            f"rowSpacingMeters: {board.spacing[1]!r}",
            f"colSpacingMeters: {board.square!r}",
        ]
    else:
        lines = [
            "target_type: 'circlegrid'",
            *lines,
            f"spacingMeters: {board.square!r}",
            f"asymmetricGrid: {board.kind == CIRCLES[True]}",
        ]
    write_text(Path(path), "\n".join(lines) + "\n")
