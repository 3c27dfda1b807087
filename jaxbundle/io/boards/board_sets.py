"""Several boards in one TOML file, for `calibrate-rig`:

    [board.front]
    columns = 9
    rows = 6
    square = 0.03
    body = "room"              # boards of one body are fixed to each other; by itself if omitted
    cameras = ["left"]         # in whose photographs it is searched; all if omitted

    [board.back]
    target = "april.yaml"      # of Kalibr, relative to this file, instead of the keys above

Keys of a board are the fields of `jaxbundle.measure.Board`. A `.yaml` file is one board of Kalibr
(`targets`).
"""

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

from jaxbundle.arguments import show
from jaxbundle.errors import InputError
from jaxbundle.io.boards.targets import read_target
from jaxbundle.io.text.csv_tables import read_toml
from jaxbundle.measure.boards import Board
from jaxbundle.network.columns import refuse_unknown
from jaxbundle.system.file_content import naming_file

OF_BOARD = tuple(field.name for field in dataclasses.fields(Board))
OF_RIG = ("target", "body", "cameras")


class BoardFile(NamedTuple):
    """Boards by name; by the name of a body, boards that are fixed to each other; by the name of a
    board, the cameras that see it, where they are stated."""

    boards: dict[str, Board]
    bodies: dict[str, list[str]]
    seen_by: dict[str, Sequence[str]]


def read_boards(path: str | Path) -> BoardFile:
    """The boards of a file.

    **Raises:** `InputError` naming file, board and key.
    """
    path = Path(path)
    if path.suffix.lower() in (".yaml", ".yml"):
        return BoardFile({"board": read_target(path)}, {}, {})
    document = read_toml(path)
    for key in document:
        refuse_unknown(key, ("board",), f"{path}: ", "section")
    sections = document.get("board")
    if not isinstance(sections, dict) or not sections:
        raise InputError(
            f"{path}: no boards; expected a section for each, such as [board.front] with columns, "
            "rows and square"
        )
    board_file = BoardFile({}, {}, {})
    for name, values in sections.items():
        where = f"{path}, [board.{name}]: "
        if not isinstance(values, dict):
            raise InputError(f"{path}: board.{name} is {show(values)}; expected a section of keys")
        for key in values:
            refuse_unknown(key, (*OF_BOARD, *OF_RIG), where)
        if ":" in name:
            raise InputError(f"{where}expected a name without a colon")
        board_file.boards[name] = _board(path, where, values)
        if "body" in values:
            board_file.bodies.setdefault(_text(where, "body", values["body"]), []).append(name)
        if "cameras" in values:
            cameras = values["cameras"]
            if not isinstance(cameras, list) or not cameras:
                raise InputError(
                    f"{where}cameras is {show(cameras)}; expected a list of names of cameras"
                )
            board_file.seen_by[name] = [_text(where, "cameras", camera) for camera in cameras]
    return board_file


def _board(path: Path, where: str, values: dict[str, Any]) -> Board:
    """One board, or that of a target file."""
    board_settings = {key: value for key, value in values.items() if key in OF_BOARD}
    if "target" in values:
        if board_settings:
            raise InputError(
                f"{where}target gives the whole board; omit {', '.join(board_settings)}"
            )
        return read_target(path.parent / _text(where, "target", values["target"]))
    for key in ("columns", "rows", "square"):
        if key not in board_settings:
            raise InputError(f"{where}{key} is missing; expected columns, rows and square")
    with naming_file(where.removesuffix(": ")):  # a Board checks its own values
        return Board(**board_settings)


def _text(where: str, key: str, value: Any) -> str:
    if not isinstance(value, str) or not value:
        raise InputError(f"{where}{key} is {show(value)}; expected text in quotes")
    return value
