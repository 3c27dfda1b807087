"""Cameras on one mounting: truth, Monte Carlo, OpenCV, photographs that do not belong together."""

import dataclasses
from functools import partial

import board_photographs as taken
import cv2
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import render
from test_calibrate import TRUTH, VIEWS, simulated

from jaxbundle.adjustment.rig import adjust_rig
from jaxbundle.adjustment.rig_normal import RigCamera, RigObject, RigValues, interior_columns
from jaxbundle.calibration import BoardViews, calibrate, calibrate_cameras, calibrate_rig
from jaxbundle.calibration.files import save_rig_plots
from jaxbundle.calibration.report import rig_dict, rig_text
from jaxbundle.calibration.rig import epoch_keys
from jaxbundle.cameras import get_model, image_ray, project
from jaxbundle.errors import InputError
from jaxbundle.geometry import matrix_from_omega_phi_kappa

pytestmark = pytest.mark.xdist_group("calibration")

NOISE = 0.05
RIGHT = render.Lens.of(fx=600.0, fy=602.0, cx=236.0, cy=181.0, k1=-0.1, k2=0.03, p1=-2e-4, p2=1e-4)
ANGLES = np.array([1.0, 6.0, -2.0])
TURN = np.asarray(matrix_from_omega_phi_kappa(np.radians(ANGLES)))
BASE = np.array([0.03, 0.004, -0.01])


def right_of(views):
    """Poses of the right camera."""
    return [(TURN @ M, X0 + M.T @ BASE) for M, X0 in views]


def pair(seed=0, noise=NOISE, moved=(), board=taken.BOARD.points):
    """Views of both cameras; at the epochs `moved` the board moved before the right one."""
    rng = np.random.default_rng(seed)
    middle = tuple(taken.BOARD.points.mean(0)[:2] + [0.01, 0])
    poses = taken.poses(VIEWS, middle=middle)
    other = right_of(poses)
    for e in moved:
        M, X0 = other[e]
        other[e] = M, X0 + [0.01, 0.005, 0.0]
    found = {}
    for name, lens, views in (("left", render.LENS, poses), ("right", RIGHT, other)):
        xy = np.array([lens.image_of(M, X0, board) for M, X0 in views])
        xy = xy + noise * rng.normal(size=xy.shape)
        names = tuple(f"{name}_{e:03d}.png" for e in range(VIEWS))
        found[name] = BoardViews(taken.BOARD, names, lens.size, xy)
    return found


def as_rig(views):
    model = get_model("opencv")
    rig = [RigCamera(model, tuple(range(9)), v.xy, v.visible) for v in views.values()]
    poses = taken.poses(VIEWS, middle=tuple(taken.BOARD.points.mean(0)[:2] + [0.01, 0]))
    middle = taken.BOARD.points.mean(0)
    truth = RigValues(
        (np.array(render.LENS.parameters), np.array(RIGHT.parameters)),
        np.array([np.zeros(3), BASE]), np.array([np.eye(3), TURN]),
        np.array([M @ (middle - X0) for M, X0 in poses]), np.array([M for M, _ in poses]),
        taken.BOARD.points - middle,
    )  # fmt: skip
    return rig, RigObject(taken.BOARD.points - middle), truth


@pytest.fixture(scope="module")
def rig():
    return calibrate_cameras(pair(), rig=True, snooping=None).rig


def test_mounting_and_cameras_are_the_truth(rig):
    assert rig.converged and len(rig.epochs) == VIEWS
    mounting = rig.mountings["right"]
    error = np.concatenate([mounting.base - BASE, mounting.angles - ANGLES]) / mounting.sigma
    assert np.abs(error).max() < 3
    assert abs(mounting.length - np.linalg.norm(BASE)) < 3 * mounting.length_sigma
    for name, lens in (("left", render.LENS), ("right", RIGHT)):
        truth = dict(zip(get_model("opencv").parameters, lens.parameters))
        for parameter, sigma in rig.sigma[name].items():
            assert abs(rig.parameters[name][parameter] - truth[parameter]) < 3.5 * sigma
            # together the cameras are known better than each by itself
            assert sigma < 1.02 * rig.cameras[name].sigma[parameter]
        assert rig.rms[name] == pytest.approx(NOISE * np.sqrt(2), rel=0.05)
    assert rig.camera("left").parameters["fx"] == rig.parameters["left"]["fx"]
    assert "right: base 0.03" in str(rig)


def test_opencv_has_the_same_residuals(rig):
    views = pair()
    board = taken.BOARD.points.astype(np.float32)
    corners = {name: [xy.astype(np.float32) for xy in v.xy] for name, v in views.items()}
    start = []
    for name in views:
        p = rig.cameras[name].parameters
        K = np.array([[p["fx"], 0, p["cx"]], [0, p["fy"], p["cy"]], [0, 0, 1]])
        start += [K, np.array([p[n] for n in ("k1", "k2", "p1", "p2", "k3")])]
    stop = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 300, 1e-14)
    rms, *_, R, T, _, _ = cv2.stereoCalibrate(
        [board] * VIEWS, corners["left"], corners["right"], *start, (480, 360),
        criteria=stop, flags=cv2.CALIB_USE_INTRINSIC_GUESS,
    )  # fmt: skip
    ours = np.sqrt(np.mean(np.square(list(rig.rms.values()))))
    assert ours == pytest.approx(rms, abs=1e-4)
    D = np.diag([1.0, -1, -1])
    mounting = rig.mountings["right"]
    np.testing.assert_allclose(D @ R @ D, mounting.rotation, atol=1e-5)
    np.testing.assert_allclose(-D @ R.T @ T.ravel(), mounting.base, atol=1e-5)


@pytest.fixture(scope="module")
def sample():
    """60 rigs from noise of their own, with the truth."""
    found = []
    for seed in range(60):
        rig, board, truth = as_rig(pair(seed))
        found.append((rig, truth, adjust_rig(rig, board, truth)))
    return found


def test_sigma_is_honest(sample):
    """Errors of the rigs over the σ each of them states."""
    errors = []
    for rig, truth, found in sample:
        assert found.converged
        sigma = found.sigma0 * np.sqrt(np.diagonal(found.cofactors))
        own = [interior_columns(rig, k) for k in (0, 1)]
        change = np.concatenate(
            [p[:9] - t[:9] for p, t in zip(found.values.interior, truth.interior)]
        )
        sigmas = np.concatenate([found.values.base[1] - BASE, change])
        sigmas /= np.concatenate([sigma[:3], sigma[own[0]], sigma[own[1]]])
        errors.append(sigmas)
    square = np.square(errors)
    assert square.mean() == pytest.approx(1, abs=0.15)
    assert (square.mean(0) < 2).all() and (square.mean(0) > 0.4).all()


@pytest.mark.parametrize("name", ["left", "right"])
@pytest.mark.parametrize("distance", [0.5, 20.0])
def test_uncertainty_in_the_rig_is_that_of_a_sample(rig, sample, name, distance):
    """Points held in the frame of the reference camera, projected by all rigs of the sample."""
    stated = rig.uncertainty(name, distance, grid=(4, 3))
    k = rig.names.index(name)
    base, turn = (BASE, TURN) if k else (np.zeros(3), np.eye(3))
    model, lens = get_model("opencv"), (render.LENS, RIGHT)[k]
    p = np.array(rig.solution.values.interior[k])
    p[: len(lens.parameters)] = lens.parameters
    rays = jax.vmap(lambda uv: jnp.stack(image_ray(model, tuple(p), *uv)))(stated.uv.reshape(-1, 2))
    Y = base + distance * np.asarray(rays) @ turn

    @jax.jit
    @partial(jax.vmap, in_axes=(None, None, None, 0))
    def image(p, base, turn, Y):
        return jnp.stack(project(model, tuple(p), *(turn @ (Y - base))))

    at = [found.values for _, _, found in sample]
    images = np.array([image(v.interior[k], v.base[k], v.turn[k], Y) for v in at])
    spread = np.sqrt(images.var(0, ddof=1).mean(1))
    ratio = spread / stated.sigma.ravel()
    assert np.sqrt(np.mean(ratio**2)) == pytest.approx(1, abs=0.15)
    assert (np.abs(ratio - 1) < 0.4).all()


def test_maps_and_coverage_of_a_rig(rig, tmp_path):
    text, numbers = rig_text(rig), rig_dict(rig)
    assert "the rig, at infinity" in text and "% of the image's cells" in text
    for name in rig.names:
        counts = rig.coverage(name).counts
        assert counts.sum() == VIEWS * 54 == np.sum(numbers["quality"][name]["coverage"]["counts"])
        far, turned = rig.uncertainty(name), rig.uncertainty(name, frame="rotation")
        assert turned.middle < far.middle
        assert rig.uncertainty(name) is far
    for arguments, said in ((("middle",), "not of the rig"), (("left", -1.0), "positive"),
                            (("left", 1.0, "scene"), "frame 'scene'")):  # fmt: skip
        with pytest.raises(InputError, match=said):
            rig.uncertainty(*arguments)
    save_rig_plots(rig, tmp_path)
    assert {f"rig_{name}_{what}.png" for name in rig.names
            for what in ("coverage", "uncertainty", "uncertainty_far")} == {
        path.name for path in tmp_path.iterdir()
    }  # fmt: skip


def test_exact_rays_from_poor_start_values():
    rig, board, truth = as_rig(pair(noise=0.0))
    poor = dataclasses.replace(
        truth, base=truth.base + [[0, 0, 0], [0.01, -0.01, 0.02]], shift=truth.shift * 1.1,
        interior=(truth.interior[0] * 1.02, truth.interior[1] * 0.97),
    )  # fmt: skip
    found = adjust_rig(rig, board, poor)
    assert found.vtpv < 1e-14
    np.testing.assert_allclose(found.values.base[1], BASE, atol=1e-9)
    np.testing.assert_allclose(found.values.turn[1], TURN, atol=1e-9)


def test_an_epoch_that_is_not_of_one_moment_is_left_out():
    views = pair(moved=(3, 8))
    found = calibrate_cameras(views, rig=True).rig
    assert {epoch for epoch, _ in found.left_out} == {"3", "8"}
    assert "photographs not of the same moment" in found.left_out[0][1]
    mounting = found.mountings["right"]
    assert (np.abs(mounting.base - BASE) < 3.5 * mounting.sigma[:3]).all()


def test_without_snooping_every_epoch_stays_and_is_named():
    """`--snooping none`: nothing is removed by the program."""
    found = calibrate_cameras(pair(moved=(3, 8)), rig=True, snooping=None).rig
    assert found.left_out == () and {"3", "8"} <= {*found.epochs} and len(found.epochs) == VIEWS
    assert {epoch for epoch, _ in found.contradicting} >= {"3", "8"}
    assert "kept, but does not fit the mounting" in rig_text(found)
    assert {*rig_dict(found)["contradicting"]} >= {"3", "8"}


def test_a_bent_board_is_estimated_with_the_rig():
    """Scale comes from the board on the whole; σ0 and the shape come out right."""
    nominal = taken.BOARD.points
    away = (nominal - nominal.mean(0))[:, 0] / 0.12
    true = nominal + np.outer(5e-4 * (away**2 - np.mean(away**2)), [0, 0, 1])
    views = pair(board=true)
    rig, board, truth = as_rig(views)
    truth = dataclasses.replace(truth, points=nominal - nominal.mean(0))
    known = adjust_rig(rig, board, truth)
    free = adjust_rig(rig, RigObject(board.given, free=True), truth)
    sharp = [dataclasses.replace(camera, weight=1 / NOISE) for camera in rig]
    weighted = adjust_rig(sharp, RigObject(board.given, sigma=5e-4), truth)
    assert weighted.sigma0 == pytest.approx(1, abs=0.1)
    assert known.converged and free.converged and weighted.converged
    assert known.sigma0 > 1.3 * NOISE
    assert free.sigma0 == pytest.approx(NOISE, rel=0.05)
    assert free.redundancy == known.redundancy - nominal.size + 7
    assert weighted.redundancy == known.redundancy
    first = interior_columns(rig, 1).stop
    sigma = free.sigma0 * np.sqrt(np.diagonal(free.cofactors)[first:]).reshape(-1, 3)
    error = free.values.points - (true - true.mean(0))
    assert np.sqrt(np.mean((error / sigma) ** 2)) == pytest.approx(1, abs=0.2)
    np.testing.assert_allclose(free.values.points.mean(0), 0, atol=1e-9)
    shape = (free.values.points - board.given) * board.given
    assert abs(shape.sum()) < 1e-9
    base = free.values.base[1] - BASE
    assert (np.abs(base) < 3.5 * free.sigma0 * np.sqrt(np.diagonal(free.cofactors)[:3])).all()
    np.testing.assert_allclose(weighted.values.points[:, 2], free.values.points[:, 2], atol=2e-5)


def test_photographs_are_paired_by_name():
    left, right = ("x/01.png", "x/02.png", "x/03.png"), ("02.jpg", "01.jpg", "03.jpg")
    keys = epoch_keys({"a": left, "b": right})
    assert keys == {"a": ["01", "02", "03"], "b": ["02", "01", "03"]}
    left, right = ("l_009.png", "l_10.png", "l_11.png"), ("r9.png", "r10.png", "r11.png")
    keys = epoch_keys({"a": left, "b": right})
    assert keys["a"] == keys["b"] == ["9", "10", "11"]
    with pytest.raises(InputError, match="cannot be paired by their names .a: 'p.png', 'q.png'"):
        epoch_keys({"a": ("p.png", "q.png"), "b": ("r.png", "s.png")})


def test_what_is_no_rig_is_refused():
    views = simulated()
    with pytest.raises(InputError, match="a rig has two cameras or more"):
        calibrate_cameras({"left": views}, rig=True)
    with pytest.raises(InputError, match="camera right: only 1 photograph"):
        calibrate_cameras({"left": views, "right": views.take([0])})
    one = calibrate(views, snooping=None)
    with pytest.raises(InputError, match="a rig has two cameras or more"):
        calibrate_rig({"left": one})
    assert TRUTH["fx"] == pytest.approx(one.parameters["fx"], abs=5)
