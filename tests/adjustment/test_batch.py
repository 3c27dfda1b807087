"""Batches of cameras against a dense least-squares solution, OpenCV, and themselves."""

from functools import partial

import cv2
import jax
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from scipy import optimize

import jaxbundle
from jaxbundle import cameras
from jaxbundle.batches import input as batch_input
from jaxbundle.batches.camera import solve_camera
from jaxbundle.batches.input import bucket, single_list
from jaxbundle.batches.normal import Sightings, residual_lengths
from jaxbundle.batches.start import start_values
from jaxbundle.geometry import omega_phi_kappa_from_matrix

SIZE = (1280, 960)
VIEWS, NOISE = 10, 0.2
BOARD = np.c_[np.mgrid[0:8, 0:5].T.reshape(-1, 2) * 0.03, np.zeros(40)] + [0.4, -0.2, 1.5]
NAMES = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3")
FLIP = np.diag([1.0, -1.0, -1.0])


def often(number: int):
    """This number of examples, always the same."""
    return settings(max_examples=number, deadline=None, derandomize=True, database=None)


def rodrigues(v):
    """exp([v]×), independent of the package."""
    angle = np.linalg.norm(v)
    x, y, z = v / max(angle, 1e-300)
    K = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * K + (1 - np.cos(angle)) * K @ K


def opencv_image(p, R, t, X):
    """Pixels by the formulas of OpenCV's documentation."""
    fx, fy, cx, cy, k1, k2, p1, p2, k3 = p
    x, y, z = R @ (X - BOARD.mean(0)).T + t[:, None]
    x, y = x / z, y / z
    r2 = x * x + y * y
    k = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
    u = fx * (x * k + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)) + cx
    v = fy * (y * k + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y) + cy
    return np.stack([u, v], 1)


def poses(rng, views=VIEWS):
    turn = rng.normal(0, 0.35, (views, 3)) * [1, 1, 0.5]
    shift = rng.uniform([-0.05, -0.04, 0.3], [0.05, 0.04, 0.5], (views, 3))
    return turn, shift


def simulate(seed, X=BOARD, image=opencv_image):
    rng = np.random.default_rng(seed)
    p = np.array([1000, 1010, 640, 475, -0.2, 0.06, 1e-3, -5e-4, 0.01])
    p[:4] += rng.normal(0, 8, 4)
    turn, shift = poses(rng)
    xy = np.stack([image(p, rodrigues(v), t, X) for v, t in zip(turn, shift)])
    return xy + rng.normal(0, NOISE, xy.shape), p, turn, shift


@pytest.fixture(scope="module")
def three():
    sets = [simulate(seed) for seed in range(3)]
    return tuple(np.stack(column) for column in zip(*sets))


@pytest.fixture(scope="module")
def solved(three):
    return jaxbundle.calibrate_batch(BOARD, three[0], SIZE)


def test_equals_a_dense_solution_with_its_standard_deviations(three, solved):
    assert list(solved.status) == ["converged"] * 3 and solved.parameters == NAMES
    xy, p, turn, shift = (column[0] for column in three)

    def residual(unknown):
        views = unknown[9:].reshape(VIEWS, 6)
        images = [opencv_image(unknown[:9], rodrigues(v[:3]), v[3:], BOARD) for v in views]
        return (np.stack(images) - xy).ravel()

    start = np.concatenate([p, np.c_[turn, shift].ravel()])
    found = optimize.least_squares(
        residual, start, jac="3-point", x_scale="jac", method="lm", ftol=1e-15, xtol=1e-15,
        gtol=1e-15,
    )  # fmt: skip
    rows, unknowns = found.jac.shape
    variance = 2 * found.cost / (rows - unknowns)
    C = variance * np.linalg.inv(found.jac.T @ found.jac)
    assert solved.redundancy[0] == rows - unknowns
    assert_allclose(solved.rms[0], np.sqrt(2 * found.cost / (rows / 2)), atol=1e-9)
    assert_allclose(solved.sigma0[0], np.sqrt(variance), rtol=1e-9)
    sigma = np.sqrt(np.diag(C))
    assert_allclose((solved.values[0] - found.x[:9]) / sigma[:9], 0, atol=1e-3)
    assert_allclose(solved.values[0, :2], found.x[:2], rtol=1e-7)
    assert_allclose(solved.sigma[0], sigma[:9], rtol=1e-4)
    scale = np.outer(sigma, sigma)[:9, :9]
    assert_allclose(solved.covariance[0] / scale, C[:9, :9] / scale, atol=1e-4)

    def orientation(view):
        M = FLIP @ rodrigues(view[:3])
        return np.r_[BOARD.mean(0) - M.T @ FLIP @ view[3:], angles_of(M)]

    for v in range(VIEWS):
        place = slice(9 + 6 * v, 15 + 6 * v)
        view = found.x[place]
        ours = np.r_[solved.position[0, v], solved.angles[0, v]]
        J = np.stack([
            (orientation(view + h) - orientation(view - h)) / 2e-6 for h in 1e-6 * np.eye(6)
        ], 1)  # fmt: skip
        expected = np.sqrt(np.diag(J @ C[place, place] @ J.T))
        assert_allclose(ours, orientation(view), atol=1e-3 * expected.max())
        assert_allclose(solved.sigma_position[0, v], expected[:3], rtol=1e-3)
        assert_allclose(solved.sigma_angles[0, v], expected[3:], rtol=1e-3)
        assert_allclose(solved.rotation[0, v], FLIP @ rodrigues(view[:3]), atol=1e-6)


@jax.jit
def angles_of(M):
    return omega_phi_kappa_from_matrix(M)


def test_equals_opencv(three):
    X = (BOARD * [1, 1, 0]).astype(np.float32)
    xy = three[0].astype(np.float32)
    ours = jaxbundle.calibrate_batch(X, xy, SIZE)
    criteria = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 100, np.finfo(float).eps)
    for camera, views in enumerate(xy):
        rms, K, distortion, *_ = cv2.calibrateCamera(
            [X] * VIEWS, list(views), SIZE, None, None, criteria=criteria
        )
        theirs = np.r_[K[0, 0], K[1, 1], K[0, 2], K[1, 2], distortion.ravel()[:5]]
        assert_allclose(ours.rms[camera], rms, atol=1e-9)
        assert_allclose(ours.values[camera], theirs, rtol=1e-5, atol=1e-7)


def same(a, b, camera_a, camera_b, rtol=0.0):
    for name in ("values", "sigma", "covariance", "sigma0", "rms", "redundancy"):
        x, y = getattr(a, name)[camera_a], getattr(b, name)[camera_b]
        assert_allclose(x, y, rtol=rtol, atol=rtol * np.abs(y).max(), err_msg=name)


def test_what_is_not_visible_counts_as_removed(three):
    xy = three[0].copy()
    points, views = np.delete(np.arange(40), [0, 7, 20]), np.delete(np.arange(VIEWS), 4)
    visible = np.zeros(xy.shape[:3], bool)
    visible[np.ix_(range(3), views, points)] = True
    xy[~visible] = np.nan
    masked = jaxbundle.calibrate_batch(BOARD, xy, SIZE, visible=visible)
    removed = jaxbundle.calibrate_batch(BOARD[points], xy[:, views][:, :, points], SIZE)
    assert masked.converged.all() and removed.converged.all()
    assert not masked.views[:, 4].any() and masked.views[:, views].all()
    assert np.isnan(masked.position[:, 4]).all()
    for camera in range(3):
        same(masked, removed, camera, camera, rtol=1e-6)
    assert_allclose(masked.position[:, views], removed.position, atol=1e-8)


def test_masked_or_nan_is_not_visible(three):
    """As in `BoardViews`: measurements that are NaN or masked, and points without coordinates."""
    xy, visible = three[0].copy(), np.random.default_rng(3).uniform(size=three[0].shape[:3]) > 0.2
    expected = jaxbundle.calibrate_batch(BOARD, xy, SIZE, visible=visible)
    assert expected.converged.all() and (expected.redundancy != expected.redundancy[0]).any()
    xy[~visible, 0] = np.nan
    hidden = np.ma.masked_array(np.nan_to_num(xy, nan=77.0), np.isnan(xy))
    mask = np.ma.masked_array(np.ones(visible.shape, bool), ~visible)
    for image_points, seen in ((xy, None), (hidden, None), (list(hidden), None), (three[0], mask)):
        found = jaxbundle.calibrate_batch(BOARD, image_points, SIZE, visible=seen)
        for camera in range(3):
            same(found, expected, camera, camera)
    without = visible.copy()
    without[:, :, 7] = False
    expected = jaxbundle.calibrate_batch(BOARD, three[0], SIZE, visible=without)
    unknown = np.ma.masked_array(BOARD, np.arange(40)[:, None] == [7] * 3)
    for X in (unknown, unknown.filled(np.nan), np.ma.stack([unknown] * 3)):
        found = jaxbundle.calibrate_batch(X, three[0], SIZE, visible=visible)
        for camera in range(3):
            same(found, expected, camera, camera)


def test_a_view_of_three_points_or_of_a_line_is_left_out(three):
    visible = np.ones(three[0].shape[:3], bool)
    visible[0, 2, 3:] = False
    visible[1, 3, 8:] = False  # the first row of the board
    found = jaxbundle.calibrate_batch(BOARD, three[0], SIZE, visible=visible)
    assert found.converged.all()
    assert [np.flatnonzero(~row).tolist() for row in found.views] == [[2], [3], []]
    without = visible.copy()
    without[0, 2] = without[1, 3] = False
    expected = jaxbundle.calibrate_batch(BOARD, three[0], SIZE, visible=without)
    for camera in range(3):
        same(found, expected, camera, camera)


def test_bad_cameras_do_not_change_the_others(three, solved):
    xy = np.concatenate([three[0], three[0], three[0]])
    visible = np.ones(xy.shape[:3], bool)
    order = [5, 0, 6, 1, 7, 2]  # good cameras at 1, 3, 5
    xy, visible = xy[order], visible[order]
    xy[0, 0, 0, 0] = np.inf
    visible[2, :, 2:] = False
    xy[4] = xy[4, :1] * [1e-3, 0] + [100, 100]  # the same line in every view
    found = jaxbundle.calibrate_batch(BOARD, xy, SIZE, visible=visible)
    assert found.status[0] == "not finite" and found.status[2] == "too few points"
    assert found.status[4] != "converged"
    assert list(found.converged) == [False, True] * 3
    for good in (0, 1, 2):
        same(found, solved, 2 * good + 1, good)
    for name in ("values", "sigma", "covariance", "sigma0", "position", "sigma_angles"):
        assert np.isnan(getattr(found, name)[[0, 2, 4]]).all(), name
    # Views that fit, though they determine no camera, do have residuals.
    assert np.isnan(found.rms[[0, 2]]).all()
    assert str(found).startswith("6 cameras") and "1 not finite" in str(found)


def test_a_batch_is_a_population(three, solved):
    population = solved.population(["a", "b", "c"])
    assert list(population.keys) == ["a", "b", "c"] and population.fit.all()
    np.testing.assert_array_equal(population.values["fx"], solved.values[:, 0])
    assert population.summary()["parameters"]["fx"]["median"] == np.median(solved.values[:, 0])
    with pytest.raises(jaxbundle.InputError, match="ids must be 3, one for each camera"):
        solved.population(["a"])


def frontal(p, views, tilt=0.0):
    """Images of the board parallel to it, but for `tilt` (radians); [views, 40, 2]."""
    rng = np.random.default_rng(7)
    turns = rng.normal(0, 1, (views, 3)) * [tilt, tilt, 0.3]
    shifts = poses(rng, views)[1]
    return np.stack([opencv_image(p, rodrigues(v), t, BOARD) for v, t in zip(turns, shifts)])


def test_views_parallel_to_the_board_determine_no_focal_length(three, solved):
    """X/Z·fx stays the same with other fx and Z: fx and fy are undetermined, and nothing else."""
    p = three[1][0]
    steps = 0.0, 0.02, 0.35
    xy = np.stack([frontal(p, VIEWS, tilt) for tilt in steps])
    xy[1:] += np.random.default_rng(0).normal(0, NOISE, xy[1:].shape)
    found = jaxbundle.calibrate_batch(BOARD, xy, SIZE)
    assert list(found.status) == ["singular", "weak", "converged"]
    expected = [[name in ("fx", "fy") for name in NAMES]] * 2 + [[False] * len(NAMES)]
    assert found.undetermined.tolist() == expected
    assert list(found.solved) == [False, True, True]
    assert np.isnan(found.values[0]).all()
    # A weak one has values, whose σ are true.
    assert (found.sigma[1, :2] > found.values[1, :2] / 50).all()
    assert np.abs((found.values[1, :4] - p[:4]) / found.sigma[1, :4]).max() < 4.5
    assert not solved.undetermined.any()


@pytest.mark.further
def test_a_principal_point_is_weak_too(three):
    """With given fx and fy, bad measurements of slightly tilted views leave it unknown."""
    p = three[1][0]
    xy = frontal(p, VIEWS, 0.02)[None] + np.random.default_rng(0).normal(0, 5, (1, VIEWS, 40, 2))
    given = dict(zip(NAMES, p))
    found = jaxbundle.calibrate_batch(BOARD, xy, SIZE, free=("cx", "cy", "p1", "p2"), start=given)
    assert list(found.status) == ["weak"]
    assert found.undetermined.tolist() == [[True, True, False, False]]
    assert (found.sigma[0, :2] > p[:2] / 50).all() and not np.isnan(found.rms[0])


@pytest.mark.further
def test_without_redundancy_there_is_no_sigma(three):
    """2 views of 4 points: 16 coordinates for 4 + 12 unknowns."""
    corners = [0, 7, 32, 39]
    visible = np.zeros(three[0].shape[:3], bool)
    visible[np.ix_(range(3), range(2), corners)] = True
    free = ("fx", "fy", "cx", "cy")
    found = jaxbundle.calibrate_batch(BOARD, three[0], SIZE, visible=visible, free=free)
    assert list(found.status) == ["too few points"] * 3 and (found.redundancy == 0).all()


def test_one_pose_over_and_over_determines_no_focal_length(three):
    p, shift = three[1][0], np.array([0.0, 0, 0.4])
    turns = [np.eye(3), rodrigues(np.array([1e-4, 0, 0])), rodrigues(np.array([0, 0, 1.0]))]
    xy = np.stack([[opencv_image(p, R, shift, BOARD)] * VIEWS for R in turns])
    noisy = xy + np.random.default_rng(0).normal(0, NOISE, xy.shape)
    found = jaxbundle.calibrate_batch(BOARD, np.concatenate([xy, noisy]), SIZE)
    assert not found.converged.any() and np.isnan(found.values[:3]).all()
    weak = found.sigma[3:, 0] / found.values[3:, 0]
    assert (np.isnan(weak) | (weak > 0.2)).all()
    assert found.undetermined[3:, :2].all()


def test_perfect_images_give_the_camera_itself(three):
    _, p, turn, shift = (column[0] for column in three)
    views = [opencv_image(p, rodrigues(v), t, BOARD) for v, t in zip(turn, shift)]
    found = jaxbundle.calibrate_batch(BOARD, np.stack(views)[None], SIZE)
    assert found.converged.all() and found.rms[0] < 1e-9
    assert_allclose(found.values[0], p, rtol=1e-7, atol=1e-9)


def test_object_points_may_be_repeated_for_every_view(three):
    xy, X = three[0], np.stack([BOARD, 2 * BOARD, 3 * BOARD])
    views = xy.shape[1]
    np.testing.assert_array_equal(single_list(BOARD, xy), BOARD)
    np.testing.assert_array_equal(single_list(BOARD[None], xy), BOARD)
    np.testing.assert_array_equal(single_list(np.tile(BOARD, (views, 1, 1)), xy), BOARD)
    np.testing.assert_array_equal(single_list(X, xy), X)
    np.testing.assert_array_equal(single_list(X[:, None].repeat(views, 1), xy), X)


@pytest.mark.further
def test_few_views_are_not_filled_up_to_many(three, solved, monkeypatch):
    """The first camera keeps every other view, the last all: each by itself or together."""
    small = partial(batch_input.PortionSettings, cameras_on_cpu=2)
    monkeypatch.setattr(batch_input, "PortionSettings", small)
    visible = np.ones(three[0].shape[:3], bool)
    visible[0, ::2] = False
    together = jaxbundle.calibrate_batch(BOARD, three[0], SIZE, visible=visible)
    small = partial(small, points_worth_compiling=0)
    monkeypatch.setattr(batch_input, "PortionSettings", small)
    apart = jaxbundle.calibrate_batch(BOARD, three[0], SIZE, visible=visible)
    np.testing.assert_array_equal(apart.views, visible.any(2))
    np.testing.assert_array_equal(apart.views, together.views)
    for name in ("values", "sigma", "position", "sigma_angles", "rms"):
        np.testing.assert_allclose(getattr(apart, name), getattr(together, name), rtol=1e-7)
    assert np.isnan(apart.position[0, ::2]).all() and np.isfinite(apart.position[0, 1::2]).all()
    np.testing.assert_allclose(apart.values[1:], solved.values[1:], rtol=1e-9)
    snooped = jaxbundle.calibrate_batch(BOARD, three[0], SIZE, visible=visible, snooping="pope")
    assert snooped.removed.shape == visible.shape and not (snooped.removed & ~visible).any()


def test_progress_is_told_and_portions_keep_the_order(three, solved):
    told = []
    xy = np.concatenate([three[0]] * 12)
    found = jaxbundle.calibrate_batch(
        BOARD, xy, SIZE, progress=lambda stage, done, total: told.append((done, total))
    )
    assert told == [(32, 36), (36, 36)]
    for camera in range(36):
        same(found, solved, camera, camera % 3)


def test_single_precision_is_read_exactly(three):
    """Every float32 number is a float64 number."""
    single = three[0].astype(np.float32)
    found = jaxbundle.calibrate_batch(BOARD, single, SIZE)
    double = jaxbundle.calibrate_batch(BOARD, single.astype(float), SIZE)
    np.testing.assert_array_equal(found.values, double.values)


@pytest.mark.further
def test_the_way_of_accelerators_gives_the_same(three, solved, monkeypatch):
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    found = jaxbundle.calibrate_batch(BOARD, three[0], SIZE)
    for camera in range(3):
        same(found, solved, camera, camera, rtol=1e-6)


@pytest.mark.further
def test_a_solid_object_with_some_parameters_held():
    rng = np.random.default_rng(5)
    X = rng.uniform(-0.12, 0.12, (40, 3)) + BOARD.mean(0)
    sets = [simulate(seed, X) for seed in (11, 12)]
    xy, truth = np.stack([s[0] for s in sets]), np.stack([s[1] for s in sets])
    start = {"k3": 0.01, "p2": truth[:, 7]}
    free = [name for name in NAMES if name not in start]
    found = jaxbundle.calibrate_batch(np.stack([X, X]), xy, SIZE, free=free, start=start)
    assert found.converged.all() and found.parameters == tuple(free)
    error = (found.values - truth[:, [0, 1, 2, 3, 4, 5, 6]]) / found.sigma
    assert np.abs(error).max() < 4.5
    assert_allclose(found.interior[:, 7], truth[:, 7])
    assert_allclose(found.sigma0, NOISE, rtol=0.1)


@pytest.mark.further
def test_a_fisheye_from_given_start_values():
    model = cameras.get_model("kannala-brandt")
    p = np.array([400.0, 402.0, 642.0, 470.0, 0.02, -0.004, 0.001, 0.0])
    rng = np.random.default_rng(3)
    turn, shift = poses(rng)
    shift[:, 2] *= 0.5
    rays = np.stack([
        FLIP @ (rodrigues(v) @ (BOARD - BOARD.mean(0)).T + t[:, None]) for v, t in zip(turn, shift)
    ])  # fmt: skip
    u, v = cameras.project(model, tuple(p), *np.moveaxis(rays, 1, 0))
    xy = np.stack([u, v], -1)[None] + rng.normal(0, NOISE, (1, VIEWS, 40, 2))
    start = {"fx": 380.0, "fy": 380.0, "k1": 0.0}
    free = ("fx", "fy", "cx", "cy", "k1", "k2")
    found = jaxbundle.calibrate_batch(
        BOARD, xy, SIZE, model="kannala-brandt", free=free, start=start | {"k3": 0.001}
    )
    assert list(found.status) == ["converged"]
    assert np.abs((found.values[0] - p[:6]) / found.sigma[0]).max() < 4.5
    assert_allclose(found.sigma0, NOISE, rtol=0.1)


def test_iteration_limit_gives_no_numbers(three):
    found = jaxbundle.calibrate_batch(BOARD, three[0], SIZE, max_iterations=2)
    assert list(found.status) == ["iteration limit"] * 3
    assert np.isnan(found.values).all() and np.isnan(found.position).all()
    assert not np.isnan(found.redundancy).any()


def test_unknowns_and_sum_of_squares_at_the_limit_are_of_one_point(three):
    """The next step is computed then, but not tried."""
    model = cameras.get_model("opencv")
    xy, points = three[0][0], BOARD - BOARD.mean(0)
    seen = Sightings(points, np.asarray(xy), np.ones(xy.shape[:2]))

    @jax.jit
    def solve(seen, first):
        usable, start = start_values(model, True, False, seen, first, float(max(SIZE)))
        solved = solve_camera(model, tuple(range(9)), 1, float(max(SIZE)), usable, start)
        return solved.cost, 0.5 * (residual_lengths(model, usable, solved.unknowns) ** 2).sum()

    first = np.zeros(len(model.parameters))
    first[2:4] = (np.array(SIZE) - 1) / 2
    cost, there = solve(seen, first)
    assert float(there) == pytest.approx(float(cost), rel=1e-9) and cost > 1


GOOD = dict(
    object_points=BOARD, image_points=np.zeros((2, 3, 40, 2)), image_size=SIZE, model="opencv"
)
BAD = {
    "points": (dict(object_points=BOARD[:7]), "[40, 3]"),
    "image points": (dict(image_points=np.zeros((3, 40, 2))), "[cameras, views, points, 2]"),
    "image points in words": (dict(image_points="seen"), "numbers [cameras, views, points, 2]"),
    "image points complex": (dict(image_points=np.zeros((2, 3, 40, 2), complex)), "complex"),
    "image points missing": (dict(image_points=[[[[1, None]]]]), "numbers"),
    "ragged image points": (dict(image_points=[[1, 2], [3]]), "its rows differ in length"),
    "object points in words": (dict(object_points=BOARD.astype(str)), "numbers [points, 3]"),
    "flat object points": (dict(object_points=BOARD[:, :2]), "[40, 3]"),
    "no camera": (dict(image_points=np.zeros((0, 3, 40, 2))), "no camera"),
    "no view": (dict(image_points=np.zeros((2, 0, 40, 2))), "no view"),
    "no point": (dict(image_points=np.zeros((2, 3, 0, 2)), object_points=BOARD[:0]), "no point"),
    "mask": (dict(visible=np.ones((2, 3))), "visible"),
    "mask in words": (dict(visible=np.full((2, 3, 40), "yes")), "true or false"),
    "mask of numbers": (dict(visible=np.full((2, 3, 40), 0.5)), "1 or 0"),
    "mask of NaN": (dict(visible=np.full((2, 3, 40), np.nan)), "1 or 0"),
    "ragged mask": (dict(visible=[[1], [1, 0]]), "differ in length"),
    "views of other objects": (
        dict(object_points=np.arange(360.0).reshape(3, 40, 3)), "differ from view to view"
    ),
    "size": (dict(image_size=(0, 960)), "image_size"),
    "size in words": (dict(image_size=("a", "b")), "width and height"),
    "size of NaN": (dict(image_size=(1280, np.nan)), "width and height"),
    "ragged size": (dict(image_size=[[1, 2], [3]]), "width and height"),
    "one size": (dict(image_size=1280), "width and height"),
    "no size": (dict(image_size=None), "width and height"),
    "unit": (dict(model="brown"), "pixels"),
    "no model": (dict(model=None), "'opencv'"),
    "model": (dict(model="opencvv"), "opencv"),
    "free": (dict(free=["fx", "k9"]), "k9"),
    "free in letters": (dict(free="fx"), "['fx', 'fy']"),
    "free a number": (dict(free=3), "['fx', 'fy']"),
    "free twice": (dict(free=["fx", "fy", "fx"]), "once"),
    "nothing free": (dict(free=[]), "at least one"),
    "start": (dict(start={"k9": 1.0}), "k9"),
    "start in words": (dict(start={"k1": "small"}), "k1 must be a number"),
    "start complex": (dict(start={"k1": 1j}), "k1 must be a number"),
    "start a word": (dict(start="fx"), "{'fx': 900.0"),
    "start behind": (dict(start={"fx": 900.0, "fy": [900.0, -1]}), "fy must be positive"),
    "no threads": (dict(threads=0), "threads must be a whole number"),
    "fewer threads": (dict(threads=-1), "threads must be a whole number"),
    "half a thread": (dict(threads=1.5), "threads must be a whole number"),
    "no iteration": (dict(max_iterations=0), "max_iterations must be a whole number"),
    "iterations without end": (dict(max_iterations=10**30), "to 10⁹"),
    "half a start": (dict(start={"fx": 900.0}), "fy"),
    "held without value": (dict(free=["cx"]), "fx"),
    "start of others": (dict(start={"k1": np.zeros(5)}), "2 cameras"),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_input_is_refused_with_what_is_expected(case):
    changed, word = BAD[case]
    with pytest.raises(jaxbundle.InputError) as error:
        jaxbundle.calibrate_batch(**(GOOD | changed))
    assert word in str(error.value) and "\n" not in str(error.value)


ODD = [np.nan, np.inf, -np.inf, 1e308, -1e200, 1e99, 1e16, 1e-308, 0.0, -1.0]


@often(60)
@given(
    name=st.sampled_from(["object_points", "image_points", "visible", "image_size"]),
    odd=st.sampled_from(ODD), part=st.integers(0, 3), seed=st.integers(0, 99),
)  # fmt: skip
def test_any_numbers_end_in_a_status(three, name, odd, part, seed):
    """A number, a point, a view or everything of one camera is odd: it alone may have no result."""
    rng = np.random.default_rng(seed)
    given = dict(
        object_points=np.stack([BOARD] * 3), image_points=three[0].copy(), image_size=[*SIZE],
        visible=np.ones(three[0].shape[:3]),
    )  # fmt: skip
    if name == "image_size":
        given[name][seed % 2] = odd
    else:
        array = given[name]
        place = tuple(rng.integers(0, n) for n in array.shape)[: max(array.ndim - part, 1)]
        array[(1, *place[1:])] = odd
    try:
        found = jaxbundle.calibrate_batch(**given)
    except jaxbundle.InputError as error:
        assert name in ("visible", "image_size") and name in str(error)
        return
    assert np.isfinite(found.sigma[found.solved]).all() and (found.sigma[found.solved] > 0).all()
    assert np.isnan(found.values[~found.solved]).all()
    if name != "image_size":
        assert found.converged[[0, 2]].all()


@pytest.mark.parametrize("X", [
    np.zeros((40, 3)), BOARD[:, [0, 0, 0]], BOARD * 1e-200, np.tile(BOARD[:3], (14, 1))[:40],
], ids=["one place", "a line", "nothing", "three places"])  # fmt: skip
def test_objects_without_extent_are_too_few_points(three, X):
    found = jaxbundle.calibrate_batch(X, three[0], SIZE)
    assert list(found.status) == ["too few points"] * 3


def test_buckets_are_few_and_never_smaller():
    sizes = [bucket(n) for n in range(1, 400)]
    assert all(size >= n for n, size in enumerate(sizes, 1))
    assert sizes == sorted(sizes) and len(set(sizes)) < 35
    assert max(size / n for n, size in enumerate(sizes, 1) if n > 3) <= 1.25
