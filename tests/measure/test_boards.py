"""Boards in rendered photographs: positions and labels of their points."""

import dataclasses
from pathlib import Path

import cv2
import numpy as np
import pytest
import render

from jaxbundle.choices import DICTIONARIES
from jaxbundle.errors import InputError
from jaxbundle.measure import Board, find_board, measure_boards, read_photograph
from jaxbundle.measure.board_sets import measure_board_set
from jaxbundle.measure.coded_targets import check_kind
from jaxbundle.measure.corners import is_chessboard, other_sizes

EXAMPLE = Path(__file__).parents[2] / "examples" / "board"
MARGIN = 0.03
CHESS = Board(9, 6, 0.03)
CIRCLES = Board(8, 6, 0.03, "circles", diameter=0.012)
UNEVEN = Board(4, 7, 0.02, "asymmetric-circles", diameter=0.012)
CHARUCO = Board(9, 6, 0.03, "charuco")
TAGS = Board(5, 4, 0.052, "aprilgrid", marker=0.04)
POSES = [(25, -20, 90, 0.5), (-20, 15, -80, 0.5), (10, 20, 175, 0.5)]


def printed(board):
    """The pattern of a board, with its points where `Board.points` says."""
    if board.kind == "chessboard":
        return render.chessboard(board.columns, board.rows, board.square)
    if board.kind == "charuco":
        dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
        size = (board.columns, board.rows)
        numbers = np.arange(board.first_marker, board.first_marker + board.markers)
        drawn = cv2.aruco.CharucoBoard(size, board.square, 0.75 * board.square, dictionary, numbers)
        picture = drawn.generateImage((120 * board.columns, 120 * board.rows), marginSize=0)
        pattern = render.print_of(picture, board.columns * board.square, MARGIN)
        return lambda X, Y: pattern(X + board.square, Y + board.square)
    if board.kind == "aprilgrid":
        dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
        side, step, gap = 120, 156, 36
        picture = np.full((board.rows * step + gap, board.columns * step + gap), 255, np.uint8)
        for row in range(board.rows + 1):
            for column in range(board.columns + 1):
                v, u = row * step, column * step
                picture[v : v + gap, u : u + gap] = 0
                if row < board.rows and column < board.columns:
                    number = (board.rows - 1 - row) * board.columns + column
                    tag = cv2.aruco.generateImageMarker(dictionary, number, side, borderBits=2)
                    picture[v + gap : v + step, u + gap : u + step] = np.rot90(tag, 2)
        gap *= board.marker / side
        pattern = render.print_of(picture, board.columns * board.square + gap, MARGIN)
        return lambda X, Y: pattern(X + gap, Y + gap)
    return render.discs(board.points[:, :2], board.diameter / 2, margin=MARGIN)


def taken(board, omega, phi, kappa, distance, seed=0):
    M, X0 = render.pose(omega, phi, kappa, board.points.mean(0)[:2], distance)
    picture = render.photograph(render.LENS, M, X0, printed(board), seed=seed)
    return picture, render.LENS.image_of(M, X0, board.points)


@pytest.mark.parametrize("board", [CHESS, CIRCLES, UNEVEN, CHARUCO, TAGS], ids=lambda b: b.kind)
@pytest.mark.parametrize("seed", range(3))
def test_every_point_is_found_and_numbered(board, seed):
    picture, true = taken(board, *POSES[seed], seed)
    found = find_board(picture, board)
    if not board.unique:
        # no photograph tells a half turn of it: the upper of the two possible points is the first
        assert found[0, 1] <= found[-1, 1]
        true = true if true[0, 1] <= true[-1, 1] else true[::-1]
    missing = np.isnan(found).any(1)
    assert missing.sum() <= (2 if board.kind == "charuco" else 0)
    error = (found - true)[~missing]
    assert np.sqrt((error**2).mean()) < 0.06
    assert np.abs(error).max() < 0.3


@pytest.mark.parametrize(
    "board", [CHESS, pytest.param(CIRCLES, marks=pytest.mark.further)], ids=lambda b: b.kind
)
def test_large_photographs_are_searched_in_small(board):
    """A photograph five times as large: found in a copy, measured in itself."""
    picture, true = taken(board, 20, 15, 10, 0.5)
    large = cv2.resize(picture, None, fx=5, fy=5, interpolation=cv2.INTER_CUBIC)
    found = find_board(large[:, :-3], board)
    true = 5 * true + 2
    assert np.abs(found - true).max() < 1.0
    assert np.sqrt(np.mean((found - true) ** 2)) < 0.3


def test_a_hidden_part_of_a_charuco_board_is_missing():
    picture, true = taken(CHARUCO, 10, 10, 0, 0.5)
    picture[:, 260:] = 128
    found = find_board(picture, CHARUCO)
    there = ~np.isnan(found).any(1)
    assert 8 < there.sum() < len(there) - 8
    assert np.abs((found - true)[there]).max() < 0.3
    assert (true[there, 0] < 262).all()


def test_coordinates_and_names():
    assert CHESS.ids[0] == "1-1" and CHESS.ids[9] == "2-1" and len(CHESS.ids) == 54
    some = [[0, 0.15, 0], [0.03, 0.15, 0], [0, 0.12, 0]]
    np.testing.assert_allclose(CHESS.points[[0, 1, 9]], some)
    assert len(CHARUCO.ids) == 40
    apart = np.linalg.norm(UNEVEN.points[:, None] - UNEVEN.points, axis=2)
    np.testing.assert_allclose(apart[apart > 0].min(), 0.02 * np.sqrt(2))
    assert CHESS.unique and not Board(8, 6, 1.0).unique and not CIRCLES.unique


@pytest.mark.parametrize("given, said", [
    ((1, 6, 0.03), "board 1x6: a chessboard board needs at least 3"),
    ((9, 6, -1.0), "square must be a positive length, but is -1.0"),
    ((9, 6, float("nan")), "square must be a positive length, but is nan"),
    ((9, 6, 1.0, "chessbord"), "did you mean 'chessboard'"),
    ((9, 6, 1.0, "charuco", None, 1.5), "a marker of 1.5 does not fit into a square of 1"),
])  # fmt: skip
def test_impossible_boards(given, said):
    with pytest.raises(InputError, match=said):
        Board(*given)


def test_dictionaries_are_those_of_opencv():
    there = {name.casefold() for name in dir(cv2.aruco) if name.startswith("DICT_")}
    assert {name.casefold() for name in DICTIONARIES} == there


@pytest.mark.parametrize("make", [
    lambda name: Board(9, 6, 0.03, "charuco", dictionary=f"DICT_{name}"),
    lambda name: check_kind(f"aruco:DICT_{name}"), lambda name: check_kind(f"apriltag:{name}"),
    lambda name: check_kind(f"charuco:8x6:DICT_{name}"),
])  # fmt: skip
def test_an_unknown_dictionary_is_refused_before_any_photograph(make):
    with pytest.raises(InputError, match="no dictionary 'DICT_.*DICT_4X4_50, .*_APRILTAG_36h11"):
        make("9X9")
    with pytest.raises(InputError, match="charuco:8: expected COLUMNSxROWS"):
        check_kind("charuco:8")
    with pytest.raises(InputError, match="ring12:codes"):
        check_kind("ring12:8")
    assert Board(9, 6, 0.03, "charuco", dictionary="dict_4x4_100").dictionary == "DICT_4X4_100"


@pytest.mark.parametrize("run", [
    ("calibrate", "photos", "--kind", "charuco"),
    ("batch", "photos", "--json-lines", "lines.jsonl"),
])  # fmt: skip
def test_the_commands_list_the_dictionaries(command, run):
    told = command(*run, "--board", "9x6", "--square", 0.03, "--dictionary", "dict_4x4_60")
    assert told.status == 2 and "'dict_4x4_60': expected one of DICT_4X4_50, " in told.err
    assert "did you mean 'DICT_4X4_50'" in told.err


def test_what_cannot_be_found_says_so():
    picture, _ = taken(CHESS, 20, 10, 5, 0.5)
    with pytest.raises(InputError, match="no chessboard of 8 × 5 inner corners"):
        find_board(np.full_like(picture, 100), Board(8, 5, 0.03))
    with pytest.raises(InputError, match="no grid of 8 × 6 circles"):
        find_board(picture, CIRCLES)
    with pytest.raises(InputError, match="fewer than 4 corners of a ChArUco"):
        find_board(picture, CHARUCO)
    with pytest.raises(InputError, match="5 × 5 pixels is too small"):
        find_board(picture[:5, :5], CHESS)
    assert other_sizes(picture, Board(10, 7, 0.03)) == CHESS
    assert other_sizes(np.full_like(picture, 100), CHESS) is None


@pytest.mark.parametrize("asked", [(7, 4), (8, 5), (5, 5), (10, 7), (8, 6)])
def test_the_board_found_instead_is_the_whole_one(asked):
    """Not the first block of it that happens to be found."""
    picture, _ = taken(CHESS, 20, 10, 5, 0.5)
    assert other_sizes(picture, Board(*asked, 0.03)) == CHESS
    assert other_sizes(picture, Board(*sorted(asked), 0.03)) in (CHESS, Board(6, 9, 0.03))


def test_circles_of_another_number():
    picture, _ = taken(CIRCLES, 10, 10, 0, 0.5)
    assert other_sizes(picture, dataclasses.replace(CIRCLES, columns=7, rows=5)) == CIRCLES


@pytest.mark.further
def test_a_part_of_the_board_is_said_to_be_one():
    """Of a board of 9 × 6 the block of 5 × 5 is found in some photographs, and no 8 × 6 in most."""
    views = measure_boards([EXAMPLE / f"photo_{i:02d}.jpg" for i in range(1, 5)], Board(5, 5, 0.03))
    (warning,) = views.warnings
    assert "part of a larger one, of 9x6" in warning and "give --board 9x6" in warning
    views = measure_boards([EXAMPLE / "photo_01.jpg", EXAMPLE / "photo_13.jpg"], CHESS)
    assert views.warnings == () and "give" not in dict(views.failed)["photo_13.jpg"]
    with pytest.raises(InputError, match="photo_01.jpg: .* give --board 9x6, if it is seen whole$"):
        measure_boards([EXAMPLE / "photo_01.jpg", EXAMPLE / "photo_02.jpg"], Board(10, 7, 0.03))


def test_reading_photographs(tmp_path):
    picture, _ = taken(CHESS, 0, 0, 0, 0.5)
    cv2.imwrite(str(tmp_path / "good.png"), picture)
    np.testing.assert_array_equal(read_photograph(tmp_path / "good.png"), picture)
    (tmp_path / "empty.jpg").write_bytes(b"")
    (tmp_path / "text.jpg").write_text("not an image")
    whole = (tmp_path / "good.png").read_bytes()
    (tmp_path / "cut.png").write_bytes(whole[:40])
    for name, said in (
        ("missing.jpg", "no such file"), (".", "is a folder"), ("empty.jpg", "is empty"),
        ("text.jpg", "not an image"), ("cut.png", "truncated"),
    ):  # fmt: skip
        with pytest.raises(InputError, match=said):
            read_photograph(tmp_path / name)


LANDSCAPES = sorted((EXAMPLE.parent / "four_photographs" / "photos").glob("*.jpg"))


def test_no_board_is_seen_in_a_landscape():
    """OpenCV's search finds boards of 3 × 3 to 5 × 3 corners in all four."""
    assert len(LANDSCAPES) == 4
    for path in LANDSCAPES:
        assert other_sizes(read_photograph(path), Board(9, 6, 0.03)) is None
    for path in sorted(EXAMPLE.glob("*.jpg"))[:2]:
        assert other_sizes(read_photograph(path), Board(7, 5, 0.03)).grid == (6, 9)


@pytest.mark.further
def test_photographs_without_a_board_get_no_size_of_one(tmp_path, command):
    """A batch of landscapes: that there is no board, and nothing to try instead."""
    photos = tmp_path / "landscapes"
    photos.mkdir()
    for path in LANDSCAPES[:2]:
        (photos / path.name).write_bytes(path.read_bytes())
    options = "--board", "9x6", "--square", 0.03
    told = command("batch", photos, *options, "--json-lines", tmp_path / "lines.jsonl")
    (line,) = (tmp_path / "lines.jsonl").read_text().splitlines()
    told_twice = command("calibrate", photos, *options)
    assert (told.status, told_twice.status) == (3, 2)
    for text in (line, told_twice.err):
        assert "no photograph of 2 shows the board" in text and "give --board" not in text, text


def test_a_board_in_a_fisheye_is_one():
    """9 × 6 corners to 67° from the axis, equidistant."""
    x, y = np.meshgrid(np.arange(9) - 4, np.arange(6) - 2.5)
    theta, phi = np.arctan2(np.hypot(x, y), 2.0), np.arctan2(y, x)
    xy = 250 * theta[..., None] * np.stack([np.cos(phi), np.sin(phi)], -1) + (350, 350)
    v, u = np.indices((700, 700))
    away = np.hypot(u - 350, v - 350) / 250
    ray = 2.0 * np.tan(np.clip(away, 0, 1.5)) / np.maximum(away, 1e-9) / 250
    square = np.floor((u - 350) * ray) + np.floor((v - 350) * ray + 0.5)
    grey = np.where(square % 2 == 1, 20, 220).astype(np.uint8)
    assert is_chessboard(cv2, grey, xy)
    assert not is_chessboard(cv2, grey, xy + np.random.default_rng(1).normal(0, 15, xy.shape))
    assert not is_chessboard(cv2, np.full_like(grey, 100), xy)


@pytest.mark.further
@pytest.mark.parametrize("first_marker", [0, 20])
def test_markers_of_another_dictionary_are_named(first_marker):
    """The board drawn has DICT_4X4_50; the dictionaries are tried, the smallest that fits named."""
    board = dataclasses.replace(CHARUCO, first_marker=first_marker)
    picture, _ = taken(board, *POSES[2])
    other = dataclasses.replace(board, dictionary="DICT_6X6_250")
    assert other_sizes(picture, other).dictionary == "DICT_4X4_50"
    assert other_sizes(np.full_like(picture, 128), other) is None


@pytest.mark.parametrize("wrong", [
    {"columns": 6, "rows": 9}, {"columns": 8}, {"columns": 10, "rows": 7}, {"columns": 12},
])  # fmt: skip
def test_the_markers_seen_tell_the_size_of_a_charuco_board(wrong):
    """Also of its negative."""
    picture, _ = taken(CHARUCO, *POSES[0])
    given = dataclasses.replace(CHARUCO, **wrong)
    for image in (picture, 255 - picture):
        with pytest.raises(InputError):
            find_board(image, given)
        assert other_sizes(image, given) == CHARUCO


def test_the_tags_seen_tell_the_columns_of_a_grid():
    picture, _ = taken(TAGS, *POSES[2])
    given = dataclasses.replace(TAGS, columns=6, rows=4)
    found = other_sizes(picture, given)
    assert (found.columns, found.rows) == (5, 4)
    assert other_sizes(picture, TAGS) is None


def test_a_board_whose_markers_do_not_begin_at_0():
    board = dataclasses.replace(CHARUCO, first_marker=20)
    picture, true = taken(board, *POSES[1])
    found = find_board(picture, board)
    there = ~np.isnan(found).any(1)
    assert there.sum() >= len(there) - 2
    assert np.abs((found - true)[there]).max() < 0.3
    assert other_sizes(picture, CHARUCO) == board
    with pytest.raises(InputError, match="DICT_4X4_50 has 50 markers"):
        find_board(picture, dataclasses.replace(board, first_marker=30))


@pytest.mark.parametrize("boards, said", [
    ({}, "boards must be by name"), ({"a:b": CHESS}, "expected a name without a colon"),
])  # fmt: skip
def test_names_of_boards_are_checked_before_any_photograph_is_read(boards, said):
    with pytest.raises(InputError, match=said):
        measure_board_set(["none.jpg"], boards)


def test_a_stretched_print_has_two_spacings():
    stretched = [30.0, 30.3, 1.0]
    for kind in ("chessboard", "circles", "charuco", "aprilgrid"):
        board = Board(5, 4, 30.0, kind, row_spacing=30.3)
        np.testing.assert_allclose(board.points[:, 0], Board(5, 4, 30.0, kind).points[:, 0])
    board = Board(5, 4, 30.0, row_spacing=30.3)
    np.testing.assert_allclose(board.points / stretched, Board(5, 4, 1.0).points)
    tags = Board(5, 4, 30.0, "aprilgrid", marker=20.0, row_spacing=30.3)
    Y = tags.points[:, 1].reshape(8, 10)[:, 0]
    np.testing.assert_allclose(-np.diff(Y), [20.0, 10.3, 20.0, 10.3, 20.0, 10.3, 20.0])
    assert "square 30 × 30.3" in str(board)


@pytest.mark.parametrize("content", [b"", b"id,X,Y,Z\n"])
def test_a_file_that_is_no_photograph_is_said_so(tmp_path, command, content):
    """Also where no file tells the size of an image, and hence the memory of a search."""
    path = tmp_path / "control.csv"
    path.write_bytes(content)
    told = command("calibrate", path, "--board", "9x6", "--square", 0.03)
    assert told.status == 2 and str(path) in told.err, told
    assert "no photograph of 1 shows the board" in told.err
