"""Corners of a board in many photographs: the `.vnl` tables of mrcal and mrgingham.

    # filename x y level
    frame0.jpg 1234.5 678.25 0
    frame1.jpg - - -

A row for each point, those of a photograph together, row after row of the board from the upper
left, as `Board.ids`; pixels, the centre of the first one is (0, 0). A photograph without a board
has one row of "-", and so has a missing point. The column `level` is how often the
photograph was reduced by 2 to find the point; a `weight` may replace it. Points of a
negative level, or without weight, are ignored.

Source: mrcal's documentation, "How to run a calibration", "corners.vnl"; vnlog's, "the format".
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from jaxbundle.errors import InputError
from jaxbundle.io.text.csv_tables import write_text
from jaxbundle.io.text.rows import TextRow, TextRows
from jaxbundle.measure.boards import Board, require_board
from jaxbundle.measure.views import BoardViews
from jaxbundle.network.columns import count, list_some

COLUMNS = ("filename", "x", "y")
QUALITY = ("level", "weight")
NO_COORDINATE = "-"


def read_corners(path: str | Path, board: Board, image_size: Sequence[int]) -> BoardViews:
    """The measured image points of a board, for `calibrate`.

    **Arguments:** `board`: with the grid of the points; `image_size`: columns and rows, which
    the table does not contain.

    **Raises:** `InputError` naming file, line and photograph.
    """
    path, number = Path(path), len(require_board(board).ids)
    legend, views, reduced_names = None, {}, {}
    for row in TextRows(path):
        # Vnlog: the first line of one # is the legend, those of ## and #! are comments.
        if row.text.startswith("#"):
            if legend is None and not row.text.startswith(("##", "#!")):
                legend = row.text.lstrip("#").split()
                if not {*COLUMNS} <= {*legend}:
                    raise row.error(f"columns {' '.join(legend)}; expected {', '.join(COLUMNS)}")
            continue
        if legend is None:
            raise row.error("expected a line '# filename x y …' before the first point")
        if len(row) != len(legend):
            raise row.error(
                f"{len(row)} values where {len(legend)} are expected ({', '.join(legend)})"
            )
        cells = dict(zip(legend, row.words))
        views.setdefault(cells["filename"], []).append(_point(row, cells))
        if cells.get("level", "0").isdigit() and int(cells.get("level", "0")) > 0:
            reduced_names[cells["filename"]] = None
    # One row of "-" stands for a whole photograph, unless the board itself has one point.
    failed_names = [
        name
        for name, points in views.items()
        if len(points) == 1 < number and np.isnan(points).all()
    ]
    for name, points in views.items():
        if name not in failed_names and len(points) != number:
            raise InputError(
                f"{path}: photograph {name!r} has {len(points)} points; the board, {board}, has "
                f"{number}"
            )
    names = [name for name in views if name not in failed_names]
    xy = np.array([views[name] for name in names], float).reshape(-1, number, 2)
    w, h = (int(n) for n in image_size)
    warnings = ()
    if reduced_names:
        warnings = (
            f"{count(len(reduced_names), 'photograph')} with points found in a reduced image, "
            f"which are less precise: {list_some(reduced_names)}",
        )
    return BoardViews(
        board,
        tuple(names),
        (w, h),
        xy,
        tuple((name, "no board found") for name in failed_names),
        warnings,
    )


def _point(row: TextRow, cells: dict[str, str]) -> tuple[float, float]:
    """A point; NaN if it was not found, or is ignored."""
    if NO_COORDINATE in (cells["x"], cells["y"]):
        return np.nan, np.nan
    # The columns may stand in any order and apart: as a row of their own they get its messages.
    x, y = TextRow(row.path, row.number, f"{cells['x']} {cells['y']}").numbers(("x", "y"))
    for name in QUALITY:
        if cells.get(name, NO_COORDINATE) != NO_COORDINATE:
            (value,) = TextRow(row.path, row.number, cells[name]).numbers((name,))
            if value < 0 or (name == "weight" and value == 0):
                return np.nan, np.nan
    return float(x), float(y)


def write_corners(views: BoardViews, path: str | Path) -> None:
    """Write the measured image points of a board.

    **Raises:** `InputError` for names with blanks.
    """
    failed_names = [name for name, _ in views.failed]
    for name in (*views.names, *failed_names):
        if any(character.isspace() for character in name) or name.startswith("#"):
            raise InputError(f"{path}: photograph {name!r}: a name cannot have blanks, nor begin #")
    lines = [f"# {' '.join(COLUMNS)} level"]
    for name, points in zip(views.names, views.xy.tolist()):
        # x != x: NaN, a point that was not found
        lines += [f"{name} - - -" if x != x else f"{name} {x!r} {y!r} 0" for x, y in points]
    lines += [f"{name} - - -" for name in failed_names]
    write_text(Path(path), "\n".join(lines) + "\n")
