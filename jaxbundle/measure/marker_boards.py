"""The board that the markers in a photograph belong to: a hint where the given one is not found.

Markers of a ChArUco board are numbered row by row from the upper left, in its white squares, tags
of a grid row by row: numbers and places of the markers seen tell the number of columns, and the
largest number the least number of rows.
"""

import dataclasses
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from jaxbundle.choices import DICTIONARIES
from jaxbundle.measure.boards import SMALLEST_SIDE, Board
from jaxbundle.measure.tag_grids import BORDER_BITS, get_dictionary, read_markers
from jaxbundle.photographs.opencv import need_opencv

Grey = UInt8[np.ndarray, "rows columns"]

# More than any board sold has.
MAX_COLUMNS = 40
# Three points of two rows fit an affine map of any numbering; six leave as many conditions.
MIN_MARKERS = 6


class SeenMarkers(NamedTuple):
    """Markers of one dictionary in a photograph: numbers, middles and half diagonals, pixels."""

    number: Int[np.ndarray, " n"]
    middle: Float[np.ndarray, "n 2"]
    size: Float[np.ndarray, " n"]


def board_of_markers(grey: Grey, board: Board) -> Board | None:
    """The board of the markers in a photograph: the given one with another number of columns and
    rows, another first marker, or another dictionary; None: not told by them, or no other."""
    for image in (grey, 255 - grey):
        markers_seen = _see_markers(image, board)
        if len(markers_seen.number) >= MIN_MARKERS:
            other_board = _of_numbers(markers_seen, board)
            return None if other_board is None or _is_part(other_board, board) else other_board
        name = _other_dictionary(image, board)
        if name is not None:
            other_board = dataclasses.replace(board, dictionary=name)
            return _of_numbers(_see_markers(image, other_board), other_board) or other_board
    return None


def _see_markers(grey: Grey, board: Board) -> SeenMarkers:
    """The markers of the board's dictionary in a photograph."""
    borders = BORDER_BITS if board.kind == "aprilgrid" else (1,)
    markers_by_border = (read_markers(grey, board.dictionary, bits) for bits in borders)
    numbers, corners = max(
        markers_by_border, key=lambda numbers_and_corners: len(numbers_and_corners[0])
    )
    size = np.linalg.norm(corners[:, 0] - corners[:, 2], axis=1) / 2
    return SeenMarkers(numbers, corners.mean(1), size)


def _is_part(other_board: Board, board: Board) -> bool:
    """Whether the other board differs in nothing but rows that may not be seen."""
    return (
        dataclasses.replace(other_board, rows=board.rows) == board
        and other_board.rows <= board.rows
    )


def _other_dictionary(grey: Grey, board: Board) -> str | None:
    """The dictionary of most markers in the photograph; of several with the same markers the
    smallest."""
    aruco = need_opencv().aruco
    dictionaries = {
        name: get_dictionary(name) for name in sorted(DICTIONARIES) if hasattr(aruco, name)
    }
    # Up to three markers may be false readings of another dictionary.
    best, largest_number = None, 3
    first, end = board.first_marker, board.first_marker + board.markers
    for name, dictionary in sorted(dictionaries.items(), key=lambda item: len(item[1].bytesList)):
        if name == board.dictionary or len(dictionary.bytesList) < end:
            continue
        numbers = _see_markers(grey, dataclasses.replace(board, dictionary=name)).number
        number = int(((numbers >= first) & (numbers < end)).sum())
        if number > largest_number:
            best, largest_number = name, number
    return best


def _of_numbers(markers_seen: SeenMarkers, board: Board) -> Board | None:
    """The board whose numbering puts the markers seen into a plane grid; None: none, or several."""
    if len(markers_seen.number) < MIN_MARKERS:
        return None
    for first_number in _first_numbers(markers_seen, board):
        fits = {
            columns: max(
                _fits(markers_seen, board.kind, markers_seen.number - first_number, columns)
            )
            for columns in range(SMALLEST_SIDE[board.kind], MAX_COLUMNS + 1)
        }
        largest_number = max(agreeing for agreeing, _ in fits.values())
        best = [columns for columns, (agreeing, _) in fits.items() if agreeing == largest_number]
        # Wrongly read numbers are rare: the codes of a dictionary differ in several bits.
        if largest_number >= max(MIN_MARKERS, 0.9 * len(markers_seen.number)) and len(best) == 1:
            rows = max(fits[best[0]][1], SMALLEST_SIDE[board.kind])
            return dataclasses.replace(board, columns=best[0], rows=rows, first_marker=first_number)
    return None


def _first_numbers(markers_seen: SeenMarkers, board: Board) -> Iterator[int]:
    """First numbers to try: the given one, 0, and the ends of the numbers seen."""
    smallest_number = int(markers_seen.number.min())
    yield from dict.fromkeys(
        n for n in (board.first_marker, 0, smallest_number) if n <= smallest_number
    )


def _fits(
    markers_seen: SeenMarkers, kind: str, k: Int[np.ndarray, " n"], columns: int
) -> Iterator[tuple[int, int]]:
    """How many markers a board of `columns` columns explains, and its least number of rows, for
    each numbering there is; `k` counts the markers from the first."""
    for place in _places(kind, k, columns):
        yield int(_agree(markers_seen, place).sum()), int(place[:, 1].max()) + 1


def _places(
    kind: str, k: Int[np.ndarray, " n"], columns: int
) -> Iterator[Float[np.ndarray, "n 2"]]:
    """Column and row of the markers, counted from 0."""
    if kind == "aprilgrid":
        yield np.stack([k % columns, k // columns], 1).astype(float)
        return
    # The second square of a ChArUco board is its first white one; in OpenCV before 4.6 the first of
    # boards of an even number of rows. Two rows of squares have as many markers as columns.
    for shift in (1, 0):
        in_first_row = len(range(shift, columns, 2))
        pair, number_in_pair = np.divmod(k, columns)
        is_second_row = number_in_pair >= in_first_row
        column = np.where(
            is_second_row,
            2 * (number_in_pair - in_first_row) + 1 - shift,
            2 * number_in_pair + shift,
        )
        yield np.stack([column, 2 * pair + is_second_row], 1).astype(float)


def _agree(markers_seen: SeenMarkers, place: Float[np.ndarray, "n 2"]) -> Bool[np.ndarray, " n"]:
    """Which markers are where a homography of the numbered places puts them."""
    cv2, nobody = need_opencv(), np.zeros(len(place), bool)
    if np.linalg.matrix_rank(place - place.mean(0)) < 2:
        return nobody
    H, _ = cv2.findHomography(
        place, markers_seen.middle, cv2.RANSAC, float(np.median(markers_seen.size))
    )
    if H is None:
        return nobody
    expected = cv2.perspectiveTransform(place[None], H)[0]
    # Half a diagonal of a marker: distortion bends a board less, and the next place is further.
    return np.linalg.norm(expected - markers_seen.middle, axis=1) < markers_seen.size
