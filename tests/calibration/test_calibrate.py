"""From rendered photographs and from corners: truth, OpenCV, boards that are not known, errors."""

import dataclasses
import importlib
from types import SimpleNamespace

import board_photographs as taken
import cv2
import numpy as np
import pytest
import render
from scipy.spatial.transform import Rotation

from jaxbundle.batches.calibrate import calibrate_batch
from jaxbundle.calibration import Board, BoardViews, calibrate
from jaxbundle.calibration.affinity import find_missing_affinity
from jaxbundle.calibration.calibrate import board_network
from jaxbundle.calibration.model_choice import _gross_points
from jaxbundle.calibration.start import start_values
from jaxbundle.cameras import get_model
from jaxbundle.errors import InputError, NotSolvedError
from jaxbundle.measure.views import measure_boards, photographs
from jaxbundle.network.tables import Camera

VIEWS, NOISE = 12, 0.05
OPENCV = get_model("opencv")
TRUTH = dict(zip(OPENCV.parameters, render.LENS.parameters))


def simulated(lens=render.LENS, board=taken.BOARD, noise=NOISE, seed=0, views=VIEWS, points=None):
    """Corners with noise instead of photographs; `points`: their true coordinates."""
    rng = np.random.default_rng(seed)
    X = board.points if points is None else points
    middle = board.points.mean(0)[:2]
    xy = np.array([lens.image_of(M, X0, X) for M, X0 in taken.poses(views, middle=middle)])
    names = tuple(f"view {i}" for i in range(views))
    return BoardViews(board, names, lens.size, xy + noise * rng.normal(size=xy.shape))


def normalised(calibration, truth):
    """Errors of the free parameters over their σ."""
    return {n: (calibration.parameters[n] - truth[n]) / s for n, s in calibration.sigma.items()}


def test_photographs_lead_to_the_truth(calibration):
    assert calibration.converged
    assert calibration.camera.image_size == (480, 360)
    errors = normalised(calibration, TRUTH)
    assert list(errors) == ["fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3"]
    assert max(map(abs, errors.values())) < 3
    assert calibration.rms < 0.06
    X0 = np.array([X0 for _, X0 in taken.poses(VIEWS)])
    order = [int(name[6:8]) for name in calibration.views.names]
    np.testing.assert_allclose(calibration.position, X0[order], atol=1e-3)
    assert "RMS 0.0" in str(calibration)


def test_files_that_failed_are_listed_with_the_reason(calibration):
    failed = dict(calibration.views.failed)
    assert set(failed) == {"empty.jpg", "text.jpg", "grey.png", "turned.png", "other.png"}
    assert failed["empty.jpg"] == "the file is empty"
    assert failed["text.jpg"].startswith("not an image")
    assert failed["grey.png"].startswith("no chessboard of 9 × 6 inner corners")
    turned = "360 × 480 pixels, most have 480 × 360: it was rotated after exposure"
    assert turned in failed["turned.png"]
    assert len(calibration.views) == VIEWS


def test_opencv_has_the_same_residuals(calibration):
    views = calibration.views
    found = calibrate(views, snooping=None)
    board = views.board.points.astype(np.float32)
    # OpenCV takes 32-bit coordinates
    corners = [xy.astype(np.float32) for xy in views.xy]
    stop = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 200, 1e-14)
    rms, K, D, *_ = cv2.calibrateCamera(
        [board] * len(views), corners, views.image_size, None, None, criteria=stop
    )
    assert found.rms == pytest.approx(rms, abs=1e-4)
    theirs = dict(zip(("fx", "fy", "cx", "cy"), (K[0, 0], K[1, 1], K[0, 2], K[1, 2])))
    theirs |= dict(zip(("k1", "k2", "p1", "p2", "k3"), D.ravel()))
    assert max(map(abs, normalised(found, theirs).values())) < 0.1


def test_sigma_is_honest():
    """σ of `calibrate` are those of `calibrate_batch`, and 224 of its calibrations follow them."""
    first = simulated()
    one = calibrate(first, snooping=None)
    exact = simulated(noise=0.0).xy
    draws = exact + NOISE * np.random.default_rng(1).normal(size=(224, *exact.shape))
    draws[0] = first.xy
    batch = calibrate_batch(taken.BOARD.points, draws, first.image_size)
    assert batch.converged.all()
    np.testing.assert_allclose(list(one.sigma.values()), batch.sigma[0], rtol=1e-5)
    truth = np.array([TRUTH[name] for name in batch.parameters])
    error = (batch.values - truth) / batch.sigma
    np.testing.assert_allclose((error**2).mean(0), 1, atol=0.35)
    np.testing.assert_allclose((error**2).mean(), 1, atol=0.1)
    np.testing.assert_allclose(error.mean(0), 0, atol=0.3)


def bent(board):
    """The points of a board that is bent by 0.5 mm and printed 0.2 % too large."""
    X = 1.002 * board.points
    middle = X.mean(0)
    away = (X - middle)[:, 0] / 0.12
    return X + np.outer(5e-4 * away**2, [0, 0, 1])


def test_a_board_with_sigma_is_control():
    start = start_values(simulated(), OPENCV, OPENCV.free)
    camera = Camera("cam", "opencv", start.parameters, ("fx",), image_size=(480, 360))
    network = board_network(start, camera, 0.1, board_sigma=2e-4)
    assert set(network.points.role) == {"control"} and (network.points.sigma == 2e-4).all()
    assert network.datum == "control" and network.residuals == "measured"
    assert (network.observations.sigma == 0.1).all()


PITCH = 0.01
BROWN = {"c": 6.2, "x0": 0.03, "y0": -0.02, "K1": 2e-3, "K2": -3e-5, "P1": 1e-5}


class InPixels:
    """A lens in mm that gives pixels."""

    size = render.LENS.size

    def __init__(self, model):
        self.lens = render.Lens.of(model=model, size=self.size, **BROWN)

    def image_of(self, *pose):
        return self.lens.image_of(*pose) / [PITCH, -PITCH] + (np.array(self.size) - 1) / 2


@pytest.mark.further
def test_a_bent_board_is_estimated_with_a_camera_in_millimetres():
    views = simulated(InPixels("brown-projected"), points=bent(taken.BOARD), noise=0.02)
    trusting = calibrate(views, snooping=None)
    free = ("c", "x0", "y0", "K1", "K2", "P1", "P2")
    found = calibrate(
        views, model="brown-projected", pixel_size=PITCH, free=free, board_free=True
    )
    assert found.rms < 0.4 * trusting.rms
    assert found.camera.pixel_size == (PITCH, PITCH)
    errors = normalised(found, BROWN | {"P2": 0.0})
    assert max(map(abs, errors.values())) < 3.5
    away = (trusting.parameters["fx"] - BROWN["c"] / PITCH) / trusting.sigma["fx"]
    assert abs(away) > 3.5
    # the shape of the board, after a similarity
    X, Y = found.adjustment.point_values, bent(taken.BOARD)
    turn, _ = Rotation.align_vectors(Y - Y.mean(0), X - X.mean(0))
    scale = np.linalg.norm(Y - Y.mean(0)) / np.linalg.norm(X - X.mean(0))
    np.testing.assert_allclose(scale * turn.apply(X - X.mean(0)), Y - Y.mean(0), atol=1e-4)


def test_start_values_of_a_correction():
    """The sign of K1 is that of the model: a correction here, a distortion above."""
    model = get_model("brown")
    start = start_values(simulated(InPixels("brown")), model, ("c", "K1"), (PITCH, PITCH))
    assert set(start.parameters) == {"c", "K1"}
    assert start.parameters["c"] == pytest.approx(6.2, rel=0.01)
    assert start.parameters["K1"] == pytest.approx(2e-3, rel=0.3)


def test_circles_lose_their_eccentricity():
    """The centres of the images of large circles are measured; only with their diameter is the
    result correct."""
    board = Board(9, 6, 0.03, "circles", diameter=0.025)
    views = simulated(board=board, noise=0.0)
    t = np.linspace(0, 2 * np.pi, 60, endpoint=False)
    rim = 0.0125 * np.stack([np.cos(t), np.sin(t), 0 * t], 1)
    xy = np.array([
        [cv2.fitEllipseDirect(rim.astype(np.float32))[0] for rim in images.reshape(54, 60, 2)]
        for images in (
            render.LENS.image_of(M, X0, (board.points[:, None] + rim).reshape(-1, 3))
            for M, X0 in taken.poses(VIEWS, middle=board.points.mean(0)[:2])
        )
    ])  # fmt: skip
    assert np.abs(xy - views.xy).max() > 0.05
    measured = dataclasses.replace(views, xy=xy)
    found = calibrate(measured, snooping=None)
    assert abs(found.parameters["fx"] - TRUTH["fx"]) < 0.01
    plain = dataclasses.replace(measured, board=dataclasses.replace(board, diameter=None))
    assert abs(calibrate(plain, snooping=None).parameters["fx"] - TRUTH["fx"]) > 0.02


def test_without_a_misfitting_photograph_the_circles_are_those_measured(monkeypatch):
    """Not those from which the eccentricity was taken in the round before it was excluded."""
    module = importlib.import_module("jaxbundle.calibration.calibrate")
    measured, taken_in = simulated(), []

    def adjust_views(start, *_):
        taken_in.append(start.views.xy)
        return dataclasses.replace(start.views, xy=start.views.xy - 0.1), None

    misfits = iter([np.arange(VIEWS) == 3, np.zeros(VIEWS - 1, bool)])
    start = lambda views, *_: SimpleNamespace(views=views, parameters={})
    monkeypatch.setattr(module, "start_values", start)
    monkeypatch.setattr(module, "_adjust_views", adjust_views)
    monkeypatch.setattr(module, "_misfitting_views", lambda *_: next(misfits))
    found = calibrate(measured, correlated=False)
    np.testing.assert_array_equal(taken_in[1], np.delete(measured.xy, 3, 0))
    np.testing.assert_allclose(found.views.xy, np.delete(measured.xy, 3, 0) - 0.1)


def test_gross_errors_are_removed():
    views = simulated()
    rng = np.random.default_rng(8)
    xy = views.xy.copy()
    bad = [(v, p) for v, p in zip(rng.integers(0, VIEWS, 12), rng.integers(0, 54, 12))]
    for v, p in bad:
        xy[v, p] += rng.choice([-1, 1], 2) * rng.uniform(1, 5)
    found = calibrate(dataclasses.replace(views, xy=xy))
    ids = taken.BOARD.ids
    removed = {r.name for r in found.adjustment.removed}
    assert {f"point {ids[p]} in image view {v}" for v, p in bad} <= removed
    assert len(removed) < len({*bad}) + 5
    assert max(map(abs, normalised(found, TRUTH).values())) < 3.5


def test_gross_errors_count_little():
    views = simulated()
    rng = np.random.default_rng(9)
    bad = rng.uniform(size=views.xy.shape[:2]) < 0.05
    xy = views.xy + np.where(bad[..., None], rng.normal(size=views.xy.shape), 0.0)
    found = calibrate(dataclasses.replace(views, xy=xy), robust="tukey")
    assert not found.adjustment.removed
    assert max(map(abs, normalised(found, TRUTH).values())) < 4
    # Models are compared without them: whatever is ten σ off.
    rows = np.argwhere((np.abs(xy - views.xy) > 10 * NOISE).any(2))
    gross = {(f"view {v}", taken.BOARD.ids[p]) for v, p in rows}
    assert gross <= _gross_points(found, 0.001)
    spoilt = calibrate(dataclasses.replace(views, xy=xy), snooping=None)
    assert abs(spoilt.parameters["fx"] - TRUTH["fx"]) > abs(found.parameters["fx"] - TRUTH["fx"])


@pytest.mark.further
def test_a_view_in_the_wrong_order_is_left_out():
    views = simulated()
    xy = views.xy.copy()
    xy[4] = xy[4].reshape(6, 9, 2)[:, ::-1].reshape(54, 2)
    xy[6] = np.random.default_rng(0).permutation(xy[6])
    xy[7, 5:] = np.nan
    start = start_values(dataclasses.replace(views, xy=xy), OPENCV, OPENCV.free)
    failed = dict(start.views.failed)
    assert set(failed) == {"view 4", "view 6", "view 7"}
    assert "as in a mirror" in failed["view 4"]
    assert "do not fit those of the other photographs" in failed["view 6"]
    assert "lie on a line" in failed["view 7"]
    assert start.parameters["fx"] == pytest.approx(620, abs=10)
    lines = np.where((np.arange(54) < 5)[:, None], views.xy, np.nan)
    with pytest.raises(NotSolvedError, match="do not determine the camera .too few points"):
        start_values(dataclasses.replace(views, xy=lines), OPENCV, OPENCV.free)
    held = start_values(views, OPENCV, ("fx", "k1"), given_values={"fy": 621.0})
    assert held.parameters["fy"] == 621.0 and held.parameters["k2"] == 0


@pytest.mark.parametrize("tilt, distances, said", [
    (0, (0.5, 0.5), "all photographs look straight at the board"),
    (25, (0.5, 0.8), "all photographs show the board tilted alike"),
])  # fmt: skip
def test_views_that_determine_no_camera_say_why(tilt, distances, said):
    """Weak, and why; never "iteration limit" with an RMS of NaN."""
    kappa = np.arange(12) * 30 if tilt == 0 else np.zeros(12)
    poses = [render.pose(tilt, 0, k, (0.12, 0.075), d)
             for k, d in zip(kappa, np.linspace(*distances, 12))]  # fmt: skip
    xy = taken.corners(render.LENS, poses)
    xy = xy + 0.05 * np.random.default_rng(0).normal(size=xy.shape)
    views = dataclasses.replace(simulated(), xy=xy)
    with pytest.raises(NotSolvedError, match=said) as error:
        calibrate(views, cross_validation=False)
    assert "iteration limit" not in str(error.value)


def test_a_board_seen_as_in_a_mirror_in_every_photograph_is_reported():
    views = simulated()
    xy = views.xy.reshape(12, 6, 9, 2)[:, :, ::-1].reshape(12, 54, 2)
    found = calibrate(dataclasses.replace(views, xy=xy), cross_validation=False)
    assert any("from behind, as in a mirror" in said for said in found.adjustment.warnings)
    assert found.parameters["fx"] == pytest.approx(620, abs=3)


def test_what_cannot_be_calibrated_says_why(folder, tmp_path):
    board = taken.BOARD
    good, bad = sorted(folder.glob("photo_*.png")), [folder / "text.jpg", folder / "grey.png"]
    for given, said in (
        (bad, "no photograph of 2 shows the board: .*text.jpg: not an image"),
        ([good[0], bad[0]], r"only 1 photograph can be used \(text.jpg: not an image"),
        ([tmp_path], "no photographs in this folder"),
        ([tmp_path / "*.jpg"], "no file matches"),
        ([], "no photographs"),
    ):
        with pytest.raises(InputError, match=said):
            calibrate(given, board)
    with pytest.raises(InputError, match="there is one of 9x6: give --board 9x6, if"):
        measure_boards(good[:1], Board(10, 7, 0.03))
    views = simulated()
    for options, said in (
        ({"model": "brown"}, "is in mm: give the size of a pixel"),
        ({"model": "opencw"}, "did you mean 'opencv'"),
        ({"free": ["fx", "K1"]}, "no free parameter 'K1'"),
        ({"pixel_size": -1}, "pixel size -1: expected a positive"),
        ({"sigma_image": 0}, "sigma_image must be a positive number"),
        ({"board_free": True, "board_sigma": 1e-4}, "either free or has a σ"),
        ({"given": {"K9": 1}}, "no parameter 'K9'"),
    ):
        with pytest.raises(InputError, match=said):
            calibrate(views, **options)
    with pytest.raises(InputError, match=r"shape \[12, 54, 2\], but have \(12, 53, 2\)"):
        dataclasses.replace(views, xy=views.xy[:, :53])


def test_a_photograph_counts_once(folder, tmp_path):
    picture = sorted(folder.glob("photo_*.png"))[0]
    told = []
    for name in ("a.png", "b.png"):
        (tmp_path / name).write_bytes(picture.read_bytes())
    views = measure_boards([tmp_path], taken.BOARD, lambda *done: told.append(done))
    assert views.names == ("a.png",) and views.failed == (("b.png", "is the same file as a.png"),)
    assert told == [("searching the board", 1, 2), ("searching the board", 2, 2)]


def test_a_photograph_saved_again_counts_once(folder, tmp_path):
    """Another compression and another format are found by their corners."""
    first, second = (cv2.imread(str(p)) for p in sorted(folder.glob("photo_*.png"))[:2])
    cv2.imwrite(str(tmp_path / "a.png"), first)
    cv2.imwrite(str(tmp_path / "b.jpg"), first, [cv2.IMWRITE_JPEG_QUALITY, 85])
    cv2.imwrite(str(tmp_path / "c.bmp"), first)
    cv2.imwrite(str(tmp_path / "d.png"), second)
    # noise of its own: another photograph of the same pose
    noise = np.random.default_rng(0).normal(0, 12, first.shape)
    cv2.imwrite(str(tmp_path / "e.png"), np.clip(first + noise, 0, 255).astype(np.uint8))
    views = measure_boards([tmp_path], taken.BOARD)
    assert views.names == ("a.png", "d.png", "e.png")
    assert [name for name, _ in views.failed] == ["b.jpg", "c.bmp"]
    assert all("where a.png does" in why for _, why in views.failed)


@pytest.mark.parametrize("ratio", [1.0, 1.002])
def test_an_affinity_that_is_left_out_is_told(ratio):
    """fy/fx = 1 + b1 in `brown`, whose one principal distance is that of y."""
    lens = render.Lens.of(**TRUTH | {"fx": 620.0, "fy": 620.0 * ratio})
    free = ("c", "x0", "y0", "K1", "K2", "P1", "P2")
    views = simulated(lens)
    found = calibrate(views, model="brown", pixel_size=0.01, free=free, snooping=None)
    missed = find_missing_affinity(found.adjustment)
    assert missed.names == ("b1", "b2")
    np.testing.assert_array_less(np.abs(missed.values - [ratio - 1, 0]), 4 * missed.sigma)
    assert missed.missed == (ratio != 1)
    told = [text for text in found.advice if "b1 and b2" in text]
    assert len(told) == (ratio != 1)
    if told:
        half = (ratio - 1) * 240
        assert missed.largest == pytest.approx(half, rel=0.25)
        assert f"up to {missed.largest:.2f} px" in told[0]


def test_names_and_patterns(tmp_path):
    for name in ("a/1.png", "b/1.png", "b/2.png"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_bytes(b"x")
    files = photographs([tmp_path / "a", str(tmp_path / "b" / "*.png"), tmp_path / "b" / "1.png"])
    assert [f.relative_to(tmp_path).as_posix() for f in files] == ["a/1.png", "b/1.png", "b/2.png"]
