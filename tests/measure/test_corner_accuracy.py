"""Points of targets of every kind against exactly rendered photographs: no bias, and σ that hold.

A corner of a marker is compared in its own photograph; positions, turns and directions of tilt are
random, so that a mean is a bias.
"""

import functools

import cv2
import numpy as np
import pytest
from exact_render import Cells, Rings, image_of, marker, photograph, plane_to_pixels

from jaxbundle.measure import Board, centre_by_ellipse, centre_by_grey_values, find_board
from jaxbundle.measure.coded_targets import find_coded_targets
from jaxbundle.measure.corners import find_board_points

BIAS = 0.02
"""Largest mean error, pixels."""


def assert_honest(error, covariance, low=0.9, high=1.1):
    """Normalised errors and the ellipse of the covariance, both of two coordinates."""
    z = error / np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
    assert low < np.sqrt((z**2).mean()) < high
    squares = np.einsum("ni,ni->n", error, np.linalg.solve(covariance, error[..., None])[..., 0])
    assert low**2 < squares.mean() / 2 < high**2


@functools.cache
def markers(side, tilt, blur, number=6, kind="DICT_4X4_50", seed=0, **options):
    """Errors of the corners of markers, also outwards, their covariance, and the reasons of those
    left out with the number expected."""
    rng = np.random.default_rng([seed, int(10 * blur), tilt, side])
    options = {"margin": 1, "inverted": False, "noise": 1.5, "around": 0.0} | options
    error, outward, covariance, left_out = [], [], [], []
    for k in range(number):
        margin = options["margin"]
        pattern, cells = marker(
            kind, int(rng.integers(50)), margin, options["around"], options["inverted"]
        )
        low, high = margin, margin + cells
        width = int(1.45 * side * (1 + 2 * margin / cells) + 24)
        H = plane_to_pixels(
            side / cells, tilt, *rng.uniform(-180, 180, 2), width / 2 + rng.uniform(-1, 1, 2),
            (cells / 2 + margin, cells / 2 + margin),
        )  # fmt: skip
        given = {name: options[name] for name in ("gamma", "levels") if name in options}
        grey = photograph(pattern, H, (width, width), blur, options["noise"], seed=k, **given)
        true = image_of(H, [[low, low], [high, low], [high, high], [low, high]])
        found = find_coded_targets(grey, f"aruco:{kind}")
        left_out += [why for _, why in found.left_out]
        for name, xy, C in zip(found.names, found.xy, found.covariance):
            corner = true[int(name.split("-")[1]) - 1]
            away = corner - true.mean(0)
            error.append(xy - corner)
            outward.append(error[-1] @ away / np.linalg.norm(away))
            covariance.append(C)
    return np.array(error), np.array(outward), np.array(covariance), left_out


CASES = [(15, 0, 0.5), (20, 0, 0.7), (30, 40, 0.6), (40, 0, 1.0), (60, 60, 0.7), (80, 30, 2.0)]


@pytest.mark.parametrize("side, tilt, blur", CASES)
def test_corners_of_markers_have_no_bias(side, tilt, blur):
    """`cornerSubPix` puts them 0.2 to 0.6 px towards the middle of the marker."""
    error, outward, _, left_out = markers(side, tilt, blur)
    assert len(error) >= 20 and len(left_out) <= 4
    assert np.abs(error.mean(0)).max() < BIAS
    assert abs(outward.mean()) < BIAS


def test_sigma_of_corners_of_markers():
    together = [markers(*case) for case in CASES]
    error = np.concatenate([found[0] for found in together])
    assert_honest(error, np.concatenate([found[2] for found in together]))


@pytest.mark.parametrize("options", [
    {"inverted": True}, {"margin": 3, "around": 1.0}, {"kind": "DICT_APRILTAG_36h11"},
    {"levels": (90.0, 140.0)}, {"gamma": 2.2, "levels": (50.0, 220.0)}, {"noise": 6.0},
], ids=str)  # fmt: skip
def test_markers_of_every_kind_and_light(options):
    """Also where the grey values are encoded: the half level is then 0.3 px beside the edge."""
    side = 56 if "kind" not in options else 64
    error, outward, covariance, _ = markers(side, 20, 0.7, number=5, **options)
    assert len(error) >= 16
    limit = max(BIAS, 3 * outward.std() / np.sqrt(len(outward)))
    assert abs(outward.mean()) < limit and np.abs(error.mean(0)).max() < limit
    assert_honest(error, covariance, 0.65, 1.35)


@pytest.mark.parametrize("side, tilt, blur", [(16, 0, 1.2), (24, 0, 2.0), (30, 65, 0.8)])
def test_what_is_too_small_is_left_out_or_says_so(side, tilt, blur):
    error, _, covariance, left_out = markers(side, tilt, blur, number=8)
    assert all("too small" in why or "no straight edge" in why for why in left_out)
    if len(error):
        sigma = np.sqrt(np.linalg.eigvalsh(covariance)[:, 1])
        assert (np.linalg.norm(error, axis=1) < 4 * sigma + BIAS).all()


def test_scale_bars_between_corners_of_markers_give_the_scale():
    """The scale of a network with bars along the sides of its markers is that of the sides
    measured: with `cornerSubPix` they were 0.9 % too short here, at 42 px a side."""
    table = np.ones((24, 36))
    words = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    for k in range(6):
        row, column = 3 + 12 * (k // 3), 3 + 12 * (k % 3)
        table[row : row + 6, column : column + 6] = (
            cv2.aruco.generateImageMarker(words, k, 6) / 255.0
        )
    H = plane_to_pixels(7.0, 25, 12, 40, (140.3, 95.8), (18, 12), 80)
    found = find_coded_targets(photograph(Cells(table, 1.0), H, (280, 192), 0.8), "aruco")
    assert len(found) == 24
    relative, weight = [], []
    for k in range(6):
        for a, b in ((1, 2), (2, 3), (3, 4), (4, 1)):
            one, other = (found.names.index(f"{k}-{c}") for c in (a, b))
            square = np.array([[0, 0], [6, 0], [6, 6], [0, 6]])
            ends = [3 + 12 * (k % 3), 3 + 12 * (k // 3)] + square[[a - 1, b - 1]]
            true = np.subtract(*image_of(H, ends)[::-1])
            side = found.xy[other] - found.xy[one]
            along = true / np.linalg.norm(true)
            relative.append((side - true) @ along / np.linalg.norm(true))
            C = found.covariance[one] + found.covariance[other]
            weight.append(true @ true / (along @ C @ along))
    scale, sigma = np.average(relative, weights=weight), np.sum(weight) ** -0.5
    # neighbouring sides share a corner, at right angles: nearly independent
    assert sigma < 1e-4 and abs(scale) < 3 * sigma


def test_long_sides_bent_by_the_lens():
    """A marker of 200 pixels beside the middle of a lens with 4 px of sagitta in its outer side."""
    pattern, cells = marker("DICT_4X4_50", 7)
    flat = photograph(pattern, plane_to_pixels(40, middle=(190, 160), centre=(4, 4)), (380, 320), 0)
    k, centre = 2.5e-7, np.array([-200.0, 160.0])
    bend = lambda p: centre + (p - centre) * (1 - k * ((p - centre) ** 2).sum(-1, keepdims=True))
    v, u = np.mgrid[:320, :380].astype(float)
    back = np.stack([u, v], -1)
    for _ in range(20):
        back = np.stack([u, v], -1) + (back - bend(back))
    bent = cv2.remap(flat, *back.astype(np.float32).transpose(2, 0, 1), cv2.INTER_CUBIC)
    found = find_coded_targets(cv2.GaussianBlur(bent, (0, 0), 0.8), "aruco")
    H = plane_to_pixels(40, middle=(190, 160), centre=(4, 4))
    true = bend(image_of(H, [[1, 1], [7, 1], [7, 7], [1, 7]]))
    middle = bend(image_of(H, [[7, 4]]))[0]
    assert abs(middle[0] - true[1:3, 0].mean()) > 1.0
    assert np.abs(found.xy - true).max() < 0.06


def chequered(columns, rows, charuco):
    """Cells of a board and its inner corners, in cells, row after row."""
    if charuco:
        words = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
        board = cv2.aruco.CharucoBoard((columns, rows), 1.0, 0.75, words)
        table, unit = board.generateImage((8 * columns, 8 * rows), marginSize=0) / 255.0, 8
    else:
        i, j = np.indices((rows, columns))
        table, unit = ((i + j) % 2).astype(float), 1
    corners = [[j, i] for i in range(1, rows) for j in range(1, columns)]
    return np.pad(table, unit, constant_values=1.0), unit * (np.array(corners, float) + 1), unit


@functools.cache
def boards(charuco, square, tilt, blur, number=2, negative=False):
    """Errors of the corners of boards, and their covariance."""
    columns, rows = 6, 5
    table, corners, unit = chequered(columns, rows, charuco)
    kind = "charuco" if charuco else "chessboard"
    board = Board(columns, rows, 1.0, kind) if charuco else Board(columns - 1, rows - 1, 1.0)
    rng = np.random.default_rng([int(10 * blur), tilt, square])
    error, covariance = [], []
    for k in range(number):
        width = int(8.8 * square + 20)
        H = plane_to_pixels(
            square / unit, tilt, rng.uniform(-40, 40), rng.uniform(-180, 180),
            width / 2 + rng.uniform(-1, 1, 2), ((columns / 2 + 1) * unit, (rows / 2 + 1) * unit),
            20 * unit,
        )  # fmt: skip
        cells = Cells(1 - table if negative else table, 0.0 if negative else 1.0)
        found = find_board_points(photograph(cells, H, (width, width), blur, seed=k), board)
        true = image_of(H, corners)
        seen = np.isfinite(found.xy).all(1)
        assert seen.mean() > 0.8
        assert found.negative == (negative and charuco)
        if negative and not charuco:
            true = true[::-1]  # the first corner is the one with a black square beyond
        error += list((found.xy - true)[seen])
        covariance += list(found.covariance[seen])
    return np.array(error), np.array(covariance)


BOARDS = [(False, 12, 0, 0.5), (False, 24, 50, 1.0), (False, 30, 0, 2.0), (True, 24, 0, 0.7),
          (True, 40, 45, 1.0)]  # fmt: skip


@pytest.mark.parametrize("case", BOARDS)
def test_corners_of_squares(case):
    """`cornerSubPix` has no bias here, but errors of 0.02 px from the pixel raster, and of 0.3 px
    where a marker reaches into its window."""
    error, _ = boards(*case)
    assert np.abs(error.mean(0)).max() < BIAS / 2
    assert np.sqrt((error**2).mean()) < 0.015


def test_sigma_of_corners_of_squares():
    together = [boards(*case) for case in BOARDS]
    assert_honest(*map(np.concatenate, zip(*together)))


@pytest.mark.parametrize("charuco", [False, True])
def test_boards_of_light_squares_on_dark_ground(charuco):
    error, _ = boards(charuco, 32, 20, 0.7, 1, negative=True)
    assert np.sqrt((error**2).mean()) < 0.01


def test_shadow_across_a_chessboard_does_not_shift_its_corners():
    """Light that decreases by 1 % a pixel."""
    table, corners, _ = chequered(6, 5, False)
    H = plane_to_pixels(24, 10, 5, 0, (112.3, 111.8), (4, 3.5), 20)
    grey = photograph(Cells(table, 1.0), H, (224, 224), 1.0, noise=0.5)
    shaded = np.clip(np.rint(grey * np.linspace(1.0, 0.1, 224)), 0, 255).astype(np.uint8)
    found = find_board(shaded, Board(5, 4, 1.0))
    true = image_of(H, corners)
    if np.abs(found - true).mean() > 1:
        true = true[::-1]
    assert np.abs((found - true).mean(0)).max() < BIAS


def centre_of_image(H, x, y, radius):
    """Centre of the image of a circle: the pole of the line at infinity."""
    circle = np.array([[1, 0, -x], [0, 1, -y], [-x, -y, x * x + y * y - radius**2]])
    dual = H @ np.linalg.inv(circle) @ H.T
    return dual[:2, 2] / dual[2, 2]


@functools.cache
def discs(radius, tilt, blur, dark, number=2):
    """Photographs of discs, and the centres of their images."""
    rng = np.random.default_rng([int(10 * radius), tilt])
    found = []
    for k in range(number):
        xy = [(5 * a + rng.uniform(), 5 * b + rng.uniform()) for a in range(4) for b in range(4)]
        width = int(27 * radius + 24)
        H = plane_to_pixels(
            radius, tilt, *rng.uniform(-180, 180, 2), (width / 2, width / 2), (8, 8), 150
        )
        parts = tuple((x, y, 0, 1, 0, 7, 0.0 if dark else 1.0) for x, y in xy)
        grey = photograph(Rings(parts, float(dark)), H, (width, width), blur, seed=k)
        found.append((grey, np.array([centre_of_image(H, x, y, 1.0) for x, y in xy])))
    return found


DISCS = [(2.5, 0, 0.7, False), (4.0, 40, 0.7, True), (8.0, 0, 1.5, False), (7.0, 55, 0.7, False)]


@pytest.mark.parametrize("measure", [centre_by_ellipse, centre_by_grey_values])
def test_centres_of_circles(measure):
    error, covariance = [], []
    for case in DISCS:
        one = []
        for grey, true in discs(*case):
            targets = [measure(grey, place + [0.7, -0.6]) for place in true]
            one += [t.xy - place for t, place in zip(targets, true)]
            covariance += [t.covariance for t in targets]
        assert np.abs(np.mean(one, axis=0)).max() < BIAS / 2
        error += one
    assert np.sqrt(np.mean(np.square(error))) < 0.012
    assert_honest(np.array(error), np.array(covariance), 0.7, 1.12)


@pytest.mark.parametrize("negative", [False, True])
def test_ring_coded_targets(negative):
    """Codes 45 and 189 of 12 bits; white on black, and printed black on white."""
    error, covariance = [], []
    for seed in range(3):
        rng = np.random.default_rng(seed)
        parts, centres = [], []
        for n in range(6):
            x, y = 8 * (n % 3) + rng.uniform(), 8 * (n // 3) + rng.uniform()
            code, phase, step = (45, 189)[n % 2], rng.uniform(0, 6), 2 * np.pi / 12
            parts += [(x, y, 0, 3.6, 0, 7, 0.0), (x, y, 0, 1, 0, 7, 1.0)]
            parts += [(x, y, 2, 3, phase + k * step, phase + (k + 1) * step, 1.0)
                      for k in range(12) if code >> (11 - k) & 1]  # fmt: skip
            centres.append((x, y))
        H = plane_to_pixels(6.0, 35, *rng.uniform(-180, 180, 2), (110, 110), (8.5, 4.5), 150)
        grey = photograph(Rings(tuple(parts), 0.0), H, (220, 220), 0.8, seed=seed)
        centres = np.array([centre_of_image(H, x, y, 1.0) for x, y in centres])
        for n in range(0, 6, 2):  # one target of each code at a time
            keep = np.full_like(grey, 30)
            for m in (n, n + 1):
                u, v = np.rint(centres[m]).astype(int)
                box = (slice(max(v - 23, 0), v + 24), slice(max(u - 23, 0), u + 24))
                keep[box] = grey[box]
            found = find_coded_targets(255 - keep if negative else keep, "ring12:codes")
            assert sorted(found.names) == ["189", "45"]
            for m in (n, n + 1):
                place = found.names.index(str((45, 189)[m % 2]))
                error.append(found.xy[place] - centres[m])
                covariance.append(found.covariance[place])
    assert np.abs(np.mean(error, axis=0)).max() < BIAS
    assert_honest(np.array(error), np.array(covariance), 0.7, 1.3)


def test_corners_of_tags_of_a_grid():
    """With the black squares of the gaps: by themselves `aprilgrid` of coded targets, and the
    board."""
    words = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
    columns, rows, cells, gap = 3, 2, 10, 3
    step = cells + gap
    table = np.ones((rows * step + gap, columns * step + gap))
    for row in range(rows + 1):
        for column in range(columns + 1):
            v, u = row * step, column * step
            table[v : v + gap, u : u + gap] = 0
            if row < rows and column < columns:
                number = (rows - 1 - row) * columns + column
                tag = cv2.aruco.generateImageMarker(words, number, cells, borderBits=2) / 255.0
                table[v + gap : v + step, u + gap : u + step] = np.rot90(tag, 2)
    table = np.pad(table, 3, constant_values=1.0)
    H = plane_to_pixels(6.0, 25, 4, 70, (160.3, 120.7), (24, 17.5), 150)
    grey = photograph(Cells(table, 1.0), H, (320, 240), 0.8)
    board = Board(columns, rows, step / cells, "aprilgrid", marker=1.0)
    found = find_board_points(grey, board)
    X = board.points[:, :2]
    plane = np.stack([3 + gap + cells * X[:, 0], 3 + rows * step - cells * X[:, 1]], 1)
    error = found.xy - image_of(H, plane)
    assert np.isfinite(error).all() and np.abs(error.mean(0)).max() < BIAS
    assert_honest(error, found.covariance, 0.7, 1.3)
    coded = find_coded_targets(grey, "aprilgrid")
    assert len(coded) >= 20
    nearest = np.linalg.norm(coded.xy[:, None] - found.xy, axis=2).min(1)
    assert nearest.max() < 0.1


def test_renderer_is_exact():
    """Edges of a square and the centre of a disc, from sums of grey values without noise."""
    H = np.array([[20.0, 0, 13.37], [0, 20.0, 11.81], [0, 0, 1]])
    grey = photograph(Cells(np.ones((1, 1)), 0.0), H, (48, 48), 0.8, 0.0, (0.0, 250.0))
    for axis, first in ((0, 13.37), (1, 11.81)):
        line = grey.sum(axis) / grey.sum(axis).max()
        assert (line @ np.arange(48)) / line.sum() == pytest.approx(first + 10, abs=2e-3)
