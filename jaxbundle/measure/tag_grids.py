"""Grids of AprilTags as Kalibr prints them: tag 0 at the lower left, numbers to the right and then
up, black squares in the gaps between the corners of tags, borders of two bits.

Tags are found and read by OpenCV. The corners of a tag are identified by its position among the
others (a homography of all of them), not by its own orientation. Grids numbered from the upper
left, and borders of one bit, are recognised.

Source: Olson (2011), AprilTag, ICRA; Kalibr's wiki, "Calibration targets".
"""

from types import ModuleType
from typing import Any

import numpy as np
from jaxtyping import Float, Int, UInt8

from jaxbundle.errors import InputError
from jaxbundle.measure.board_points import BoardPoints, make_points
from jaxbundle.measure.boards import Board, find_dictionary
from jaxbundle.measure.saddles import fit_saddles

Grey = UInt8[np.ndarray, "rows columns"]

# Four middles, not in one row, determine the homography of the grid.
MIN_TAGS = 4

# Kalibr prints tags with borders of two bits, everybody else of one.
BORDER_BITS = 2, 1


def get_dictionary(name: str) -> Any:
    """OpenCV's dictionary of this name.

    **Raises:** `InputError` for an unknown one, or one that the installed OpenCV lacks."""
    import cv2

    name = find_dictionary(name)
    if not hasattr(cv2.aruco, name):
        raise InputError(f"OpenCV {cv2.__version__} has no dictionary {name}; install a newer one")
    return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, name))


def read_markers(
    grey: Grey, dictionary: str, border_bits: int = 1
) -> tuple[Int[np.ndarray, " markers"], Float[np.ndarray, "markers 4 2"]]:
    """Numbers and corners of the markers of a dictionary in a photograph, without those that are
    seen twice."""
    import cv2

    parameters = cv2.aruco.DetectorParameters()
    parameters.markerBorderBits = border_bits
    detector = cv2.aruco.ArucoDetector(get_dictionary(dictionary), parameters)
    corners, ids, _ = detector.detectMarkers(grey)
    ids = np.zeros(0, int) if ids is None else ids.ravel().astype(int)
    occurs_once = np.bincount(ids, minlength=1)[ids] == 1
    corners_seen = np.array([four[0] for four in corners], float).reshape(-1, 4, 2)
    return ids[occurs_once], corners_seen[occurs_once]


def find_tags(cv2: ModuleType, grey: Grey, board: Board) -> BoardPoints:
    """The corners of the tags in a photograph.

    **Raises:** `InputError` for fewer than four tags, or tags in one row.
    """
    ids, corners_seen = max(
        (_read_tags(grey, board, bits) for bits in BORDER_BITS),
        key=lambda numbers_and_corners: len(numbers_and_corners[0]),
    )
    tag_row, tag_column = np.divmod(ids - board.first_marker, board.columns)
    if len(ids) < MIN_TAGS or not (np.ptp(tag_row) and np.ptp(tag_column)):
        raise InputError(
            f"fewer than {MIN_TAGS} tags of a grid of {board.columns} × {board.rows} tags "
            f"({board.dictionary}), or only of one row, found"
        )
    for place in (board.rows - 1 - tag_row, tag_row):  # from the bottom, from the top
        # Points of the board that are the corners of the tags, by their row from the top.
        i, j = 2 * place[:, None] + [0, 0, 1, 1], 2 * tag_column[:, None] + [0, 1, 1, 0]
        corners: Int[np.ndarray, "tags 4"] = i * 2 * board.columns + j
        expected = _places(cv2, board.points[corners, :2], corners_seen)
        if expected is not None:
            break
    else:
        raise InputError(f"the tags found are not those of a flat grid: {board}")
    side = np.linalg.norm(np.diff(corners_seen, axis=1), axis=2).min(1)
    # The squares of the gaps end where the next tag begins, in sides of a tag.
    gap = min(1.0, min(board.spacing) / board.marker_side - 1)
    xy, rows, lines = [], [], []
    for which, expected_corners, four, length in zip(corners, expected, corners_seen, side):
        distance = np.linalg.norm(expected_corners[:, None] - four, axis=2)
        # In sides of the tag; larger: wrongly read tags pass; smaller: tags at the edge of a wide
        # lens are lost, where the homographies fit worst; not critical.
        if len({*distance.argmin(1).tolist()}) == 4 and distance.min(1).max() < 0.25 * length:
            xy += list(expected_corners)  # OpenCV's corners reach into the squares of the gaps
            rows += which.tolist()
            step = gap * (np.roll(expected_corners, -1, 0) - expected_corners)
            lines += list(np.stack([step, np.roll(step, 1, 0)], 1))
    if not rows:
        raise InputError(f"the tags found are not those of a flat grid: {board}")
    return make_points(fit_saddles(grey, np.array(xy), np.array(lines)), np.array(rows), board)


def _read_tags(
    grey: Grey, board: Board, bits: int
) -> tuple[Int[np.ndarray, " tags"], Float[np.ndarray, "tags 4 2"]]:
    """Numbers and corners of the tags of a board; those read twice are left out."""
    ids, corners_seen = read_markers(grey, board.dictionary, bits)
    number = ids - board.first_marker
    of_board = (number >= 0) & (number < board.markers)
    return ids[of_board], corners_seen[of_board]


def _places(
    cv2: ModuleType, X: Float[np.ndarray, "tags 4 2"], corners_seen: Float[np.ndarray, "tags 4 2"]
) -> Float[np.ndarray, "tags 4 2"] | None:
    """Corners [tags, 4, 2] by homographies of the middles of neighbouring tags, so that distortion
    matters little; None for a mirror image."""
    middle, middle_seen = X.mean(1), corners_seen.mean(1)
    H, _ = cv2.findHomography(middle, middle_seen, cv2.LMEDS)
    if H is None or np.linalg.det(H / H[2, 2]) > 0:  # Y of the board is up, v down
        return None
    places = np.empty(X.shape)
    for tag, four in enumerate(X):
        # 3 × 3 tags about this one: over more, distortion bends the homography; over fewer, the
        # places scatter by the noise of the middles
        nearest = np.argsort(np.linalg.norm(middle - middle[tag], axis=1))[:9]
        flat = np.linalg.matrix_rank(middle[nearest] - middle[tag]) == 2
        local = (
            cv2.findHomography(middle[nearest], middle_seen[nearest])[0]
            if flat and len(nearest) > 3
            else H
        )
        places[tag] = cv2.perspectiveTransform(four[None], H if local is None else local)[0]
    return places
