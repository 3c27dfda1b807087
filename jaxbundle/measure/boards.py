"""Boards: flat objects whose points are found and numbered in photographs.

The points form rows, numbered from the top, each from the left: "1-1", "1-2", ….
X runs along the rows to the right, Y up, Z towards the viewer; the origin is the left point of the
last row.

| kind | points | COLUMNS × ROWS counts |
|---|---|---|
| `chessboard` | corners of the squares | inner corners |
| `circles` | centres of the circles | circles |
| `asymmetric-circles` | the same, every other row shifted by half a step | circles of a row, rows |
| `charuco` | corners of the squares; may be hidden in part | squares |
| `aprilgrid` | corners of AprilTags (Kalibr); may be hidden in part | tags |

The first corner of a chessboard has a black square beyond it, to the upper left; if a half turn
does not change the colours (columns + rows even), the upper of the two possible corners in the
photograph is the first. For circles in straight rows a half turn is not recognised either. This
does not matter for a board with known points, but for one with estimated points
(`Board.unique`).
"""

import dataclasses

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxbundle.arguments import integer, number, show
from jaxbundle.choices import BOARDS, DICTIONARIES
from jaxbundle.errors import InputError
from jaxbundle.network.columns import did_you_mean

# Minimum columns and rows of a board, counted as users state them: a chessboard has as many inner
# corners as OpenCV's detection needs, the others the four points that a pose needs (three squares
# of a ChArUco board have two corners between them).
SMALLEST_SIDE = {
    "chessboard": 3,
    "circles": 2,
    "asymmetric-circles": 2,
    "charuco": 3,
    "aprilgrid": 2,
}
# Dictionaries of `charuco` and `aprilgrid`, if none is given.
ARUCO, APRILTAGS = "DICT_4X4_50", "DICT_APRILTAG_36h11"


@dataclasses.dataclass(frozen=True)
class Board:
    """A board: number, spacing and kind of its points.

    **Fields:**

    - `columns`, `rows`: as the table above counts them.
    - `square`: side of a square, or distance of neighbouring circles, in the object unit; for
      `asymmetric-circles` the distance of neighbouring rows, half that of circles in a row, for
      `aprilgrid` the distance of neighbouring tags, side and gap.
    - `kind`: see the table.
    - `diameter`: of the circles, object unit: their images are then corrected for eccentricity.
    - `marker`, `dictionary`: side and OpenCV dictionary of the markers of `charuco`, or of the tags
      of `aprilgrid`; of tags the default stands for DICT_APRILTAG_36h11, Kalibr's.
    - `row_spacing`: distance of neighbouring rows (of tags for `aprilgrid`), if a print has
      stretched them: `square` is then that along the rows only.
    - `first_marker`: number of the first marker of `charuco` or `aprilgrid` in the dictionary, of
      the second and third board of a set for instance.

    **Raises:** `InputError` for an impossible board.
    """

    columns: int
    rows: int
    square: float
    kind: str = "chessboard"
    diameter: float | None = None
    marker: float | None = None
    dictionary: str = ARUCO
    row_spacing: float | None = None
    first_marker: int = 0

    def __post_init__(self):
        if not isinstance(self.kind, str) or self.kind not in BOARDS:
            raise InputError(f"kind of board {self.kind!r}{did_you_mean(self.kind, BOARDS)}")
        smallest_side = SMALLEST_SIDE[self.kind]
        for name in ("columns", "rows"):
            integer(f"board: {name}", getattr(self, name), least=0)
        # 300 × 300 is more than any camera resolves; more is a slip that would fill the memory.
        if self.columns * self.rows > 100_000:
            raise InputError(
                f"board {self.columns}x{self.rows}: expected at most 100 000 of its fields"
            )
        if min(self.columns, self.rows) < smallest_side:
            raise InputError(
                f"board {self.columns}x{self.rows}: a {self.kind} board needs at least "
                f"{smallest_side} columns and rows"
            )
        for name in ("square", "diameter", "marker", "row_spacing"):
            value = getattr(self, name)
            if value is not None or name == "square":
                is_length = lambda x: 0 < x < np.inf
                length = number(f"board: {name}", value, "a positive length", is_length)
                object.__setattr__(self, name, length)
        if self.kind == "aprilgrid":
            object.__setattr__(self, "marker", self.marker_side)
            if self.dictionary == ARUCO:
                object.__setattr__(self, "dictionary", APRILTAGS)
        object.__setattr__(self, "dictionary", find_dictionary(self.dictionary))
        smallest = min(self.spacing)
        if self.marker is not None and self.marker >= smallest:
            raise InputError(
                f"board: a marker of {self.marker:g} does not fit into a square of {smallest:g}"
            )
        if self.row_spacing is not None and self.kind == "asymmetric-circles":
            raise InputError("board: asymmetric-circles have one spacing, that of their rows")
        integer("board: first marker", self.first_marker, least=0)
        if self.first_marker and self.kind not in ("charuco", "aprilgrid"):
            raise InputError(f"board: a {self.kind} board has no markers, so no first one")

    @property
    def spacing(self) -> tuple[float, float]:
        """Distances of neighbouring columns and of neighbouring rows, object unit."""
        return self.square, self.row_spacing or self.square

    @property
    def markers(self) -> int:
        """Number of markers or tags."""
        if self.kind == "aprilgrid":
            return self.columns * self.rows
        return self.columns * self.rows // 2 if self.kind == "charuco" else 0

    @property
    def marker_side(self) -> float:
        """Side of a marker or tag, object unit: `marker`, or ¾ of a square if that is not given.

        Only ratios matter to the detection, and it tolerates another one: OpenCV's example boards
        have ½ to ¾, Kalibr's tags 1/1.3 of the step."""
        return self.marker or 0.75 * self.square

    @property
    def grid(self) -> tuple[int, int]:
        """Rows and columns of points."""
        if self.kind == "aprilgrid":
            return 2 * self.rows, 2 * self.columns
        is_charuco = self.kind == "charuco"
        return self.rows - is_charuco, self.columns - is_charuco

    @property
    def grids(self) -> tuple[tuple[int, int], ...]:
        """The grids of points: one, that of a `BoardSet` has one for each board."""
        return (self.grid,)

    @property
    def diameters(self) -> Float[np.ndarray, " points"]:
        """Diameters of the circles, object unit; 0 for corners and where none is given."""
        circles = self.diameter if "circles" in self.kind else None
        return np.full(len(self.ids), circles or 0.0)

    @property
    def ids(self) -> tuple[str, ...]:
        """Names of the points, row after row from the top: "row-column"."""
        rows, columns = self.grid
        return tuple(f"{i}-{j}" for i in range(1, rows + 1) for j in range(1, columns + 1))

    @property
    def points(self) -> Float[np.ndarray, "points 3"]:
        """Coordinates in the object unit, in the order of `ids`."""
        rows, columns = self.grid
        i, j = np.mgrid[0:rows, 0:columns].reshape(2, -1)
        column_spacing, row_spacing = self.spacing
        if self.marker is not None and self.kind == "aprilgrid":
            place = lambda k, step: k // 2 * step + k % 2 * self.marker
            return np.stack(
                [place(j, column_spacing), place(rows - 1 - i, row_spacing), np.zeros(len(i))], 1
            )
        half_columns = 2 * j + i % 2 if self.kind == "asymmetric-circles" else j
        return np.stack(
            [column_spacing * half_columns, row_spacing * (rows - 1 - i), np.zeros(len(i))], 1
        )

    @property
    def unique(self) -> bool:
        """Whether points are identified in a photograph even after a half turn of the board."""
        if self.kind == "chessboard":
            return (self.columns + self.rows) % 2 == 1
        if self.kind == "asymmetric-circles":
            return self.rows % 2 == 1
        return self.kind in ("charuco", "aprilgrid")

    def __str__(self) -> str:
        sides = " × ".join(f"{side:g}" for side in dict.fromkeys(self.spacing))
        first_marker_words = f", markers from {self.first_marker}" if self.first_marker else ""
        return f"{self.kind} {self.columns}x{self.rows}, square {sides}{first_marker_words}"


@dataclasses.dataclass(frozen=True)
class BoardSet:
    """Boards by name, as one object of many points. It has what a `Board` has of points; boards do
    not share a frame: X and Y of each begin at its own origin.

    **Fields:** `names`, `boards`: in the same order.
    """

    names: tuple[str, ...]
    boards: tuple[Board, ...]

    @property
    def ids(self) -> tuple[str, ...]:
        """Names of the points, "BOARD:row-column"."""
        return tuple(f"{name}:{id}" for name, board in self.items for id in board.ids)

    @property
    def points(self) -> Float[np.ndarray, "points 3"]:
        """Coordinates in the frame of the own board, object unit, in the order of `ids`."""
        return np.concatenate([board.points for board in self.boards])

    @property
    def items(self) -> tuple[tuple[str, Board], ...]:
        """Names and boards."""
        return tuple(zip(self.names, self.boards))

    @property
    def number(self) -> Int[np.ndarray, " points"]:
        """The index of the board of each point."""
        return np.repeat(np.arange(len(self.boards)), [len(board.ids) for board in self.boards])

    @property
    def grids(self) -> tuple[tuple[int, int], ...]:
        """Rows and columns of points of each board."""
        return tuple(board.grid for board in self.boards)

    @property
    def diameters(self) -> Float[np.ndarray, " points"]:
        """Diameters of the circles, object unit; 0 for corners and where none is given."""
        return np.concatenate([board.diameters for board in self.boards])

    @property
    def unique(self) -> bool:
        """Whether the points of every board are identified even after a half turn of it."""
        return all(board.unique for board in self.boards)

    def seen(self, visible: Bool[np.ndarray, "views points"]) -> Int[np.ndarray, " views"]:
        """The index of the board of each view."""
        return self.number[visible.argmax(1)]

    def __str__(self) -> str:
        return "; ".join(f"{name}: {board}" for name, board in self.items)


def find_dictionary(name: str) -> str:
    """The dictionary of markers of this name, in capitals or not.

    **Raises:** `InputError` with all names, before any photograph is read."""
    by_folded_name = {
        name_of_dictionary.casefold(): name_of_dictionary for name_of_dictionary in DICTIONARIES
    }
    if not isinstance(name, str) or name.casefold() not in by_folded_name:
        raise InputError(
            f"there is no dictionary {show(name)} of markers; known: {', '.join(DICTIONARIES)}"
        )
    return by_folded_name[name.casefold()]


def require_board(board: Board) -> Board:
    """The board, or an error about another argument.

    **Raises:** `InputError`."""
    if not isinstance(board, Board):
        raise InputError(f"board must be a Board, such as Board(9, 6, 0.03), but is {show(board)}")
    return board
