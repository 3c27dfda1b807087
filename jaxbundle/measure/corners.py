"""Detection of boards in photographs by OpenCV, with the numbering of `boards`.

Corners of squares are fitted to the grey values around them (`saddles`), circles by `targets`: each
with its covariance. Boards of light squares on dark ground, the negative of the usual ones, are
searched if nothing else is found. Boards are searched in a reduced copy of a large photograph (24
million pixels take 25 s, one of 1600 columns 1 s), points are measured in the original.
"""

import dataclasses
from collections.abc import Callable
from types import ModuleType
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8

from jaxbundle.errors import InputError
from jaxbundle.measure.board_points import BoardPoints, make_points
from jaxbundle.measure.boards import SMALLEST_SIDE, Board
from jaxbundle.measure.marker_boards import board_of_markers
from jaxbundle.measure.saddles import Saddles, fit_saddles, lines_of_grid
from jaxbundle.measure.tag_grids import find_tags, get_dictionary
from jaxbundle.measure.targets import centre_by_ellipse
from jaxbundle.photographs.opencv import need_opencv
from jaxbundle.photographs.reading import image_errors

Grey = UInt8[np.ndarray, "rows columns"]
Places = Float[np.ndarray, "n 2"]
# Image points of a board by row and column.
Grid = Float[np.ndarray, "rows columns 2"]

# Longer sides of the reduced copies in which boards are searched in turn, in pixels. The first
# takes a second (see above); the second, of four times the pixels, finds squares of half the size.
SIDES = (1600, 3200)
# The same for boards of other sizes, a hint only, in a quarter of the pixels of the first copy.
QUICK_SIDE = 800


def find_board(grey: Grey, board: Board) -> Float[np.ndarray, "points 2"]:
    """The image points of a board in a photograph, pixels; NaN for missing points.

    **Raises:** `InputError` with the reason if there are none.
    """
    return find_board_points(grey, board).xy


def find_board_points(grey: Grey, board: Board) -> BoardPoints:
    """The image points of a board in a photograph with their covariance; boards that are the
    negative of the usual ones too.

    **Raises:** `InputError` with the reason if there are none.
    """
    cv2 = need_opencv()
    if min(grey.shape) < 16:
        raise InputError(f"the image of {grey.shape[1]} × {grey.shape[0]} pixels is too small")
    finders = {"chessboard": _chessboard, "charuco": _charuco, "aprilgrid": find_tags}
    find = finders.get(board.kind, _circles)
    with image_errors():
        try:
            return find(cv2, grey, board)
        except InputError as error:
            # Circles are searched light and dark anyway.
            if find is _circles or find is _chessboard and not _is_in_small(cv2, 255 - grey, board):
                raise
            try:
                return dataclasses.replace(find(cv2, 255 - grey, board), negative=True)
            except InputError:
                raise error from None


def memory_of_search(rows: int, columns: int, kind: str) -> float:
    """Bytes that the search of a board of a kind takes in a photograph, beside its grey values."""
    # Bytes a pixel, measured in a photograph of 3072 × 2048 pixels: in a search of markers 6; of a
    # chessboard that is not there, the worst case, 230 of the largest copy.
    if kind in ("charuco", "aprilgrid"):
        return 6 * rows * columns
    factor = min(1.0, SIDES[-1] / max(rows, columns, 1))
    return 230 * factor**2 * rows * columns


def _is_in_small(cv2: ModuleType, grey: Grey, board: Board) -> bool:
    """Whether a chessboard is in a small copy of a photograph: much faster than a full search."""
    small, _ = _reduce(cv2, grey, QUICK_SIDE)
    is_found, _ = cv2.findChessboardCornersSB(
        small, (board.columns, board.rows), flags=cv2.CALIB_CB_NORMALIZE_IMAGE
    )
    return is_found


def other_sizes(grey: Grey, board: Board) -> Board | None:
    """The largest board of another size, of the same kind, in the photograph.

    Chessboards of any size; circles with columns and rows exchanged, or some less or more of
    either; boards of markers as the markers seen tell: of another size, with another first number,
    or of another dictionary.
    """
    if board.kind == "chessboard":
        other_board = largest_chessboard(grey, board)
        return None if other_board == board else other_board
    if board.kind in ("charuco", "aprilgrid"):
        return board_of_markers(grey, board)
    m, n = board.columns, board.rows
    similar_sizes = [(n, m)] + [
        (m + i, n + j) for i in (-1, 0, 1) for j in (-1, 0, 1) if (i, j) != (0, 0)
    ]
    grey, _ = _reduce(need_opencv(), grey, QUICK_SIDE)
    # A part of a board is a board too: the largest is searched first.
    for columns, rows in sorted(similar_sizes, key=lambda size: -size[0] * size[1]):
        try:
            other_board = dataclasses.replace(board, columns=columns, rows=rows)
            find_board(grey, other_board)
            return other_board
        except InputError:
            continue
    return None


def largest_chessboard(grey: Grey, board: Board) -> Board | None:
    """The chessboard in the photograph with all its corners, of any number; searched in a
    reduced copy. More columns than rows, or as in `board`. None for textures that the search takes
    for a small board."""
    cv2 = need_opencv()
    grey, _ = _reduce(cv2, grey, QUICK_SIDE)
    smallest_side = SMALLEST_SIDE["chessboard"]
    flags = cv2.CALIB_CB_LARGER | cv2.CALIB_CB_EXHAUSTIVE | cv2.CALIB_CB_NORMALIZE_IMAGE
    try:
        is_found, xy, grid = cv2.findChessboardCornersSBWithMeta(
            grey, (smallest_side, smallest_side), flags
        )
    except cv2.error:
        return None
    if not is_found or not is_chessboard(cv2, grey, xy.reshape(*grid.shape[:2], 2).astype(float)):
        return None
    rows, columns = sorted(grid.shape[:2])
    if board.columns < board.rows:
        rows, columns = columns, rows
    return dataclasses.replace(board, columns=columns, rows=rows)


def is_chessboard(
    cv2: ModuleType,
    grey: Grey,
    xy: Grid,
    least_contrast: float = 0.5,
    misfit_of_four: float = 0.05,
    largest_misfit: float = 0.25,
) -> bool:
    """Whether a grid of corners has the evidence of a chessboard: its squares alternate, and every
    3 × 3 corners are the image of a plane grid.

    The search finds boards of 3 × 3 to 5 × 3 corners in each of 57 photographs of landscapes,
    fronts and rooms. They and 9 photographs of a board were compared by the smallest difference of
    neighbouring squares, in units of the mean difference, and by the largest RMS of 3 × 3 corners
    against their homography, in units of their step:

    - `least_contrast`: a board has 0.97; 51 of the 57 have less than ½, the others are 3 × 3;
    - `misfit_of_four`: a board has 0.007, those six 0.072 and more. That of four squares; it grows
      with the number of squares, since no texture of more than four alternates,
    - up to `largest_misfit`: a fisheye with 9 × 6 corners to 120° from the axis has 0.24.
    """
    middle = (xy[:-1, :-1] + xy[1:, 1:] + xy[:-1, 1:] + xy[1:, :-1]) / 4
    column, row = np.rint(middle).astype(int).reshape(-1, 2).T
    shade = grey[row, column].astype(float).reshape(middle.shape[:2])
    sign = 1 - 2 * (np.indices(shade.shape).sum(0) % 2)
    steps = [np.diff(shade, axis=k) * np.delete(sign, 0, axis=k) for k in (0, 1)]
    steps = np.concatenate([step.ravel() for step in steps])
    steps *= np.sign(steps.mean())  # either colour may be the first
    if not steps.min() >= least_contrast * steps.mean() > 0:
        return False
    plane = np.stack(np.meshgrid(np.arange(3.0), np.arange(3.0)), -1).reshape(-1, 2)
    misfit = 0.0
    for i, j in np.ndindex(len(xy) - 2, len(xy[0]) - 2):
        nine_corners = xy[i : i + 3, j : j + 3].reshape(-1, 2)
        H, _ = cv2.findHomography(plane, nine_corners)
        if H is None:
            return False
        difference = cv2.perspectiveTransform(plane[None], H)[0] - nine_corners
        step = (
            np.sqrt(
                abs(
                    np.linalg.det(
                        [nine_corners[2] - nine_corners[0], nine_corners[6] - nine_corners[0]]
                    )
                )
            )
            / 2
        )
        misfit = max(misfit, np.sqrt(np.mean(np.sum(difference**2, 1))) / max(step, 1.0))
    return misfit <= min(misfit_of_four * shade.size / 4, largest_misfit)


def _chessboard(cv2: ModuleType, grey: Grey, board: Board) -> BoardPoints:
    size = (board.columns, board.rows)

    def seek(grey: Grey) -> Any:
        # The detector of Duda and Frese (2018) first, the older one where it finds nothing.
        flags = cv2.CALIB_CB_EXHAUSTIVE | cv2.CALIB_CB_ACCURACY | cv2.CALIB_CB_NORMALIZE_IMAGE
        is_found, xy = cv2.findChessboardCornersSB(grey, size, flags=flags)
        if not is_found:
            flags = cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_NORMALIZE_IMAGE
            is_found, xy = cv2.findChessboardCorners(grey, size, flags=flags)
        return xy if is_found else None

    xy = _in_copies(cv2, grey, seek)
    if xy is None:
        raise InputError(
            f"no chessboard of {size[0]} × {size[1]} inner corners found: it must be seen whole, "
            "with a light margin"
        )
    xy = _first_black(grey, _turn_upright(xy.reshape(*board.grid, 2)), board)
    lines = lines_of_grid(xy).reshape(-1, 2, 2)
    return make_points(fit_saddles(grey, xy.reshape(-1, 2), lines), np.arange(xy.size // 2), board)


def _in_copies(
    cv2: ModuleType, grey: Grey, seek: Callable[[Grey], Any]
) -> Float[np.ndarray, "n 2"] | None:
    """The result of `seek` in reduced copies, in pixels of the image; None: nothing found."""
    sides = [side for side in SIDES if side < max(grey.shape)]
    for side in (*sides, max(grey.shape))[: len(SIDES)]:
        copy, factor = _reduce(cv2, grey, side)
        xy = seek(copy)
        if xy is not None:
            return factor * xy.reshape(-1, 2).astype(float) + (factor - 1) / 2
    return None


def _reduce(cv2: ModuleType, grey: Grey, side: int) -> tuple[Grey, int]:
    """The image reduced by a whole factor to the maximum side; and the factor."""
    factor = -(-max(grey.shape) // side)
    if factor < 2:
        return grey, 1
    rows, columns = (n // factor * factor for n in grey.shape)
    size = (columns // factor, rows // factor)
    return cv2.resize(grey[:rows, :columns], size, interpolation=cv2.INTER_AREA), factor


def _turn_upright(xy: Grid) -> Grid:
    """Rows from the top, each from the left: not mirrored, the first row at the top."""
    row_direction, column_direction = xy[:, -1] - xy[:, 0], xy[-1] - xy[0]
    if np.linalg.det([row_direction.sum(0), column_direction.sum(0)]) < 0:
        xy = xy[:, ::-1]
    (x, y), (u, v) = xy[0, 0], xy[-1, -1]
    return xy if (y, x) <= (v, u) else xy[::-1, ::-1]


def _first_black(grey: Grey, xy: Grid, board: Board) -> Grid:
    """The one of two or four possible numberings with a black first square."""
    turns = [xy, xy[::-1, ::-1]]
    if board.columns == board.rows:
        quarter = xy[:, ::-1].swapaxes(0, 1)
        turns += [quarter, quarter[::-1, ::-1]]
    return max(turns, key=lambda xy: _contrast(grey, xy))


def _contrast(grey: Grey, xy: Grid) -> float:
    """Sign of the grey-value difference between squares of the other and of the first colour; 0:
    undecided."""
    middle = (xy[:-1, :-1] + xy[1:, 1:] + xy[:-1, 1:] + xy[1:, :-1]) / 4
    column, row = np.rint(middle).astype(int).reshape(-1, 2).T
    shade = grey[row, column].astype(float).reshape(middle.shape[:2])
    i, j = np.indices(shade.shape)
    is_first_colour = (i + j) % 2 == 0
    return np.sign(shade[~is_first_colour].mean() - shade[is_first_colour].mean())


def _charuco(cv2: ModuleType, grey: Grey, board: Board) -> BoardPoints:
    aruco, dictionary = cv2.aruco, get_dictionary(board.dictionary)
    marker = board.marker_side
    best, markers_seen = None, {}
    numbers = np.arange(board.first_marker, board.first_marker + board.markers)
    if numbers[-1] >= len(dictionary.bytesList):
        raise InputError(
            f"{board}: {board.dictionary} has {len(dictionary.bytesList)} markers, from 0"
        )
    # OpenCV before 4.6 began boards of an even number of rows with a white square
    for legacy in (False, True):
        size = (board.columns, board.rows)
        known_board = aruco.CharucoBoard(size, min(board.spacing), marker, dictionary, numbers)
        known_board.setLegacyPattern(legacy)
        # Markers are searched once: they take the time.
        xy, ids, *markers = aruco.CharucoDetector(known_board).detectBoard(grey, **markers_seen)
        if markers[1] is None:
            break
        markers_seen = dict(zip(("markerCorners", "markerIds"), markers))
        if ids is not None and (best is None or len(ids) > len(best[1])):
            best = xy.reshape(-1, 2), ids.ravel()
    if best is None or len(best[1]) < 4:
        raise InputError(
            f"fewer than 4 corners of a ChArUco board of {board.columns} × {board.rows} squares "
            f"with {board.dictionary} markers found"
        )
    xy, ids = best
    X = board.points[ids, :2] / board.spacing
    on_grid = np.full((*board.grid, 2), np.nan)
    on_grid.reshape(-1, 2)[ids] = xy
    lines = lines_of_grid(on_grid).reshape(-1, 2, 2)[ids]
    # Least median of squares: corners interpolated from a wrongly read marker are outliers.
    H, _ = cv2.findHomography(X, xy, cv2.LMEDS)
    if H is None:
        raise InputError("the corners of the ChArUco board found lie on a line")
    image = lambda X: cv2.perspectiveTransform(X[None], H)[0]
    expected = np.stack([image(X + [1, 0]) - image(X), image(X + [0, -1]) - image(X)], 1)
    lines = np.where(np.isfinite(lines), lines, expected)
    return make_points(fit_saddles(grey, xy, lines, _strips(image, X, lines, board)), ids, board)


def _strips(
    image: Callable[[Places], Places],
    X: Places,
    lines: Float[np.ndarray, "n 2 2"],
    board: Board,
) -> Float[np.ndarray, "n 2 2 2"]:
    """Distances of the corners of markers from the lines through the corners of a ChArUco board,
    for `fit_saddles`."""
    width = (1 - board.marker_side / np.array(board.spacing)) / 2
    normal = np.stack([-lines[..., 1], lines[..., 0]], 2)
    normal /= np.linalg.norm(normal, axis=2)[..., None]
    strips, rows = np.empty((len(X), 2, 2, 2)), np.arange(len(X))
    for right in (-1, 1):
        for side in (-1, 1):
            distance = np.einsum("ni,nki->nk", image(X + width * [right, side]) - image(X), normal)
            is_beyond_first, is_beyond_second = (distance > 0).astype(int).T
            strips[rows, is_beyond_first, is_beyond_second] = np.abs(distance)
    return strips


def _circles(cv2: ModuleType, grey: Grey, board: Board) -> BoardPoints:
    size = (board.columns, board.rows)
    uneven = board.kind == "asymmetric-circles"
    flags = cv2.CALIB_CB_ASYMMETRIC_GRID if uneven else cv2.CALIB_CB_SYMMETRIC_GRID

    def seek(grey: Grey) -> Any:
        for shade in (0, 255):
            finder = _blob_finder(cv2, grey, shade)
            for further_flags in (0, cv2.CALIB_CB_CLUSTERING):
                is_found, xy = cv2.findCirclesGrid(
                    grey, size, flags=flags | further_flags, blobDetector=finder
                )
                if is_found:
                    return xy
        return None

    xy = _in_copies(cv2, grey, seek)
    if xy is None:
        raise InputError(
            f"no grid of {size[0]} × {size[1]} circles found: it must be seen whole and sharp"
        )
    xy = xy.reshape(*board.grid, 2)
    if uneven:
        xy = _number_asymmetric(xy)
    else:
        xy = _turn_upright(xy)
    targets = [centre_by_ellipse(grey, place) for place in xy.reshape(-1, 2)]
    centres = Saddles(
        np.array([t.xy for t in targets]),
        np.array([t.covariance for t in targets]),
        np.full(len(targets), "", dtype=object),
    )
    return make_points(centres, np.arange(len(targets)), board)


def _blob_finder(cv2: ModuleType, grey: Grey, shade: int) -> Any:
    """Round blobs of any size in the image; the limit of OpenCV is 5000 pixels."""
    parameters = cv2.SimpleBlobDetector_Params()
    parameters.blobColor = shade
    # Of 4 pixels across to an eighth of the image, a board of 3 × 3; ellipses of circles seen
    # obliquely, far from round; not the background between them, which is not convex.
    parameters.minArea, parameters.maxArea = 15, grey.size / 8
    parameters.minDistBetweenBlobs = 4
    parameters.filterByInertia, parameters.minInertiaRatio = True, 0.05
    parameters.filterByConvexity, parameters.minConvexity = True, 0.85
    return cv2.SimpleBlobDetector_create(parameters)


def _number_asymmetric(xy: Grid) -> Grid:
    """The numbering with the second row shifted to the right, not mirrored."""

    def fits(xy: Grid) -> bool:
        row_direction, column_direction = xy[0, -1] - xy[0, 0], xy[-1] - xy[0]
        shift = (xy[1] - xy[0]).mean(0)
        straight = (xy[2] - xy[0]).mean(0) / 2 if len(xy) > 2 else 0 * shift
        return (
            np.linalg.det([row_direction, column_direction.mean(0)]) > 0
            and (shift - straight) @ row_direction > 0
        )

    turns = [xy, xy[::-1, ::-1], xy[::-1], xy[:, ::-1]]
    good = [turned for turned in turns if fits(turned)]
    if not good:
        raise InputError("the rows of circles are not shifted as those of an asymmetric grid")
    return min(good, key=lambda xy: (xy[0, 0, 1], xy[0, 0, 0]))
