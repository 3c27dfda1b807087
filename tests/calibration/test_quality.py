"""The quality of a calibration: Monte Carlo of projections, halves, coverage, words."""

import dataclasses
import json
import sys
from types import SimpleNamespace

import board_photographs as taken
import numpy as np
import pytest
import render
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation
from test_calibrate import NOISE, simulated

import jaxbundle
from jaxbundle import cli
from jaxbundle.adjustment.quality.expected_difference import expected_difference
from jaxbundle.adjustment.quality.projection_uncertainty import images_through_scene
from jaxbundle.batches.calibrate import calibrate_batch
from jaxbundle.batches.calibrate_rigs import calibrate_rigs
from jaxbundle.calibration import Calibration, calibrate, report
from jaxbundle.calibration import result as results
from jaxbundle.calibration.advice import (
    advice,
    many_not_used,
    misfitting_views,
    often_removed,
    suggest,
)
from jaxbundle.calibration.files import json_text, write_calibration, write_calibrations
from jaxbundle.calibration.quality import coverage, grid_of, uncertainty_map
from jaxbundle.calibration.simulate import simulate_views
from jaxbundle.cameras import compare_cameras, get_model
from jaxbundle.cameras.convert_fit import images_of
from jaxbundle.errors import InputError
from jaxbundle.geometry import matrix_from_omega_phi_kappa
from jaxbundle.io import read_cameras, read_network, read_opencv
from jaxbundle.io.cameras.result_json import read_calibrated
from jaxbundle.plotting import write_figures
from jaxbundle.report.lens_advice import (
    ADVICE_ON_FIELD,
    FEWER,
    RICHER,
    SIGNIFICANT_ONLY,
    advise_parameters,
)

DRAWS = 416
GRID = (3, 3)
UV = grid_of((480, 360), *GRID).reshape(-1, 2)


def rays_of(p, uv):
    lens = render.Lens(tuple(p), (480, 360))
    return np.array(render._rays(get_model("opencv"), lens.parameters, uv[:, 0], uv[:, 1]))


def image_of(p, rays):
    """OpenCV's formula, for arrays of cameras [draws, parameters, 1] and rays [draws, n, 3]."""
    fx, fy, cx, cy, k1, k2, p1, p2, k3 = np.moveaxis(p[:, :9, None], 1, 0)
    x, y = -rays[..., 0] / rays[..., 2], rays[..., 1] / rays[..., 2]
    r2 = x * x + y * y
    k = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    u = fx * (x * k + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)) + cx
    v = fy * (y * k + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y) + cy
    return np.stack([u, v], -1)


@pytest.fixture(scope="module")
def sample():
    """One calibration, and 416 others of the same views under other noise."""
    views = simulated()
    exact = simulated(noise=0.0).xy
    draws = exact + NOISE * np.random.default_rng(11).normal(size=(DRAWS, *exact.shape))
    batch = calibrate_batch(taken.BOARD.points, draws, views.image_size)
    assert batch.converged.all()
    return calibrate(views, snooping=None), batch


def root_mean_square(images):
    """σ as a map gives it, of a sample [draws, n, 2]."""
    return np.sqrt(images.var(0, ddof=1).mean(1))


@pytest.mark.further
def test_uncertainty_in_the_camera_frame_is_that_of_a_sample(sample):
    calibration, batch = sample
    images = image_of(batch.interior, rays_of(render.LENS.parameters, UV)[None])
    stated = calibration.uncertainty(frame="camera", grid=GRID)
    np.testing.assert_allclose(stated.sigma.ravel(), root_mean_square(images), rtol=0.1)


def test_uncertainty_without_rotation_is_that_of_a_sample(sample):
    """Of every calibration the rotation that moves its images least is taken off."""
    calibration, batch = sample
    rays = rays_of(render.LENS.parameters, UV)
    truth = image_of(np.array([render.LENS.parameters]), rays[None])[0]

    def turned(theta, p):
        return image_of(p[None], Rotation.from_rotvec(theta).apply(rays)[None])[0]

    images = []
    for p in batch.interior[:150]:
        away = lambda theta, p=p: (turned(theta, p) - truth).ravel()
        images.append(turned(least_squares(away, np.zeros(3), x_scale=1e-3).x, p))
    stated = calibration.uncertainty(frame="rotation", grid=GRID).sigma.ravel()
    # what is left in the middle is a thirtieth of what is left in the corners, and of fewer draws
    corner = [0, 2, 6, 8]
    found = root_mean_square(np.array(images))
    np.testing.assert_allclose(stated[corner], found[corner], rtol=0.12)
    np.testing.assert_allclose(stated, found, atol=0.1 * stated.max())


@pytest.mark.parametrize("distance", [0.5, np.inf])
def test_uncertainty_in_the_scene_is_that_of_a_sample(sample, distance):
    calibration, batch = sample
    rays = rays_of(render.LENS.parameters, UV)
    near = 1 / distance
    images = []
    for i, (M, X0) in enumerate(taken.poses(len(calibration.views))):
        fixed = rays @ M + near * X0
        seen = fixed - near * batch.position[:, i, None]
        images.append(image_of(batch.interior, seen @ batch.rotation[:, i].swapaxes(1, 2)))
    found = root_mean_square(np.mean(images, 0))
    stated = calibration.uncertainty(distance, grid=GRID)
    np.testing.assert_allclose(stated.sigma.ravel(), found, rtol=0.1)
    assert stated.middle == stated.sigma[1, 1]
    assert stated.corners == stated.sigma[[0, 0, 2, 2], [0, 2, 0, 2]].max()


@pytest.mark.further
def test_the_uncertainty_map_of_a_spline_is_that_of_a_sample():
    """A grid of splines for OpenCV's lens: σ of a point at the distance of the board, over the
    measured part of the image, against calibrations of the same views under other noise. Beyond it
    the knots are held at start values that the same views gave, and the stated σ is too small."""
    views, model, draws = simulated(), get_model("spline-6x5-60"), 64
    exact = simulated(noise=0.0).xy
    noise = NOISE * np.random.default_rng(5).normal(size=(draws, 1, *exact.shape))
    batch = calibrate_rigs(
        taken.BOARD.points, exact + noise, views.image_size, model=model.name
    )
    assert (batch.status == "converged").all()
    near, poses, grid = 1 / 0.5, taken.poses(len(views)), (9, 7)
    uv = grid_of((480, 360), *grid).reshape(-1, 2)
    fixed = [rays_of(render.LENS.parameters, uv) @ M + near * X0 for M, X0 in poses]
    images = []
    for result in batch.adjustments:
        values = {name: one["value"] for name, one in result.cameras["cam"]["parameters"].items()}
        X0, angles = np.split(result.image_values, 2, axis=1)
        M = [np.asarray(matrix_from_omega_phi_kappa(a)) for a in angles]
        rays = np.array([(f - near * x) @ m.T for f, x, m in zip(fixed, X0, M)])
        images.append(images_of(model, values, rays.reshape(-1, 3)).reshape(len(M), -1, 2).mean(0))
    found = root_mean_square(np.array(images))
    stated = calibrate(views, model=model.name, snooping=None).uncertainty(0.5, grid=grid)
    away = np.linalg.norm(uv[:, None] - exact.reshape(-1, 2), axis=2)
    inside = (away < 40).sum(1) > 4
    ratio = stated.sigma.ravel() / found
    assert inside.sum() > 20 and np.mean(ratio[inside]) == pytest.approx(1, abs=0.12)
    assert (np.abs(ratio[inside] - 1) < 0.3).all()


def test_the_expected_mapping_error_is_that_of_a_sample(sample):
    """K of calibrations against the truth, each with its best rotation; mean and quantile."""
    calibration, batch = sample
    truth = dict(zip(get_model("opencv").parameters, render.LENS.parameters))
    K = []
    for values in batch.interior[:100]:
        other = dict(zip(truth, values.tolist()))
        model = get_model("opencv")
        found = compare_cameras((model, truth), (model, other), image_size=(480, 360))
        K.append(found.rms**2)
    stated = calibration.mapping_error
    assert stated.expected == pytest.approx(np.mean(K), rel=0.3)
    assert stated.rms < stated.quantile() and stated.weights.shape == (9,)
    assert np.mean(np.array(K) < stated.quantile() ** 2) == pytest.approx(0.95, abs=0.05)
    of_map = calibration.uncertainty(frame="rotation", grid=(33, 25)).covariance
    trace = np.trace(of_map, axis1=2, axis2=3).mean()
    assert stated.expected == pytest.approx(trace, rel=1e-6)


@pytest.fixture(scope="module")
def without_corners():
    """A calibration of a wide lens whose polynomial turns back before the image corners."""
    rng = np.random.default_rng(4)
    board = jaxbundle.Board(9, 6, 0.08)
    camera = jaxbundle.Camera(
        "cam", "opencv",
        {"fx": 470, "fy": 471, "cx": 372, "cy": 238, "k1": -0.32, "k2": 0.153, "k3": -0.045},
        image_size=(752, 480),
    )  # fmt: skip
    middle = board.points.mean(0)
    stations = jaxbundle.stations_looking_at(
        middle + rng.uniform([-0.5, -0.4, 0.5], [0.5, 0.4, 0.9], (12, 3)),
        middle + rng.uniform([-0.2, -0.1, 0], [0.2, 0.1, 0], (12, 3)), up=(0, 1, 0),
    )  # fmt: skip
    views = simulate_views(board, camera, stations, noise=0.1)
    return calibrate(views, cross_validation=False)


def test_image_points_without_rays_have_no_uncertainty_and_the_others_have_theirs(without_corners):
    """One point without a ray made the whole map NaN, and its corners 0."""
    found = without_corners
    for one in (*found.reported_maps, found.uncertainty(1.0)):
        outside = np.isnan(one.sigma)
        assert outside[[0, 0, -1, -1], [0, -1, 0, -1]].all() and np.isnan(one.corners)
        assert outside.mean() < 0.5 and one.middle > 0
    # the middle is that of the same function asked for nothing else
    model = get_model("opencv")
    xy = np.array([[375.5, 239.5]])
    adjustment = found.adjustment
    function = images_through_scene(model, ("camera", 0), np.arange(12), adjustment.values, xy, 1.0)
    Q = adjustment.covariance_of(function)
    assert found.uncertainty(1.0).middle == pytest.approx(np.sqrt(np.trace(Q) / 2), rel=1e-9)
    middle, corners = found.uncertainty_over_distance(np.array([1.0, 3.0]))
    assert (middle > 0).all() and np.isnan(corners).all()


def test_what_is_not_there_is_a_dash_in_the_report_and_null_in_json(without_corners, tmp_path):
    text, data = without_corners.report(), without_corners.to_dict()
    table = text.split("Uncertainty of a projected point")[1].split("Expected")[0].split("\n\n")[0]
    rows = [line.split() for line in table.splitlines()[2:]]
    assert len(rows) == 5 and all(row[-1] == "–" and float(row[-2]) > 0 for row in rows)
    json.loads(json.dumps(data, allow_nan=False))
    maps = data["calibration"]["uncertainty"]
    assert all(one["corners"] is None and one["middle"] > 0 for one in maps)


def test_the_mapping_error_of_the_measured_part_is_that_of_its_map(without_corners):
    found, error = without_corners, without_corners.mapping_error
    assert 0.5 < error.measured.share < error.share < 1
    assert error.measured.rms < error.rms
    of_map = found.uncertainty(frame="rotation", grid=(33, 25))
    C = np.trace(of_map.covariance, axis1=2, axis2=3)
    assert np.isfinite(C).mean() == pytest.approx(error.share)
    assert error.expected == pytest.approx(np.nanmean(C), rel=1e-6)
    words = found.report().split("Expected mapping error")[1].split(".  ")[0]
    assert f"{error.measured.rms:.3f}" in words and f"{error.rms:.3f}" in words


def test_maps_that_cannot_be(sample):
    adjustment = sample[0].adjustment
    with pytest.raises(InputError, match="must be one of camera, rotation, scene, not 'board'"):
        uncertainty_map(adjustment, "cam", frame="board")
    with pytest.raises(InputError, match="distance 0: expected a positive"):
        uncertainty_map(adjustment, "cam", 0.0)


@pytest.mark.further
def test_two_halves_agree_unless_the_camera_changed(calibration):
    found = calibration.cross_validation
    assert 0.1 < found.test < 3
    assert 0 < found.comparison.rms < 0.5 and found.comparison.unit == "px"
    assert found.rms_own < calibration.rms < found.rms_other < 1.3 * calibration.rms
    views = simulated()
    zoomed = dataclasses.replace(
        render.LENS, parameters=(660.0, 661.0, *render.LENS.parameters[2:])
    )
    other = simulated(zoomed).xy
    mixed = np.where((np.arange(len(views)) % 2 == 1)[:, None, None], other, views.xy)
    changed = calibrate(dataclasses.replace(views, xy=mixed), snooping=None)
    assert changed.cross_validation.test > 100
    # Not the largest, which is in a corner of the image without points.
    assert changed.cross_validation.comparison.rms > 10 * found.comparison.rms
    assert any("halves of the photographs contradict" in text for text in changed.advice)


def test_halves_are_advised_about_once_they_were_made(calibration, monkeypatch):
    """Also if the advice was read before."""
    found = Calibration(calibration.views, calibration.adjustment, True)
    monkeypatch.setattr(results, "advice", lambda *given: ["halves"] * (given[-1] is not None))
    monkeypatch.setattr(results.quality, "cross_validation", lambda _: "made")
    assert "halves" not in found.shortcomings
    assert found.cross_validation == "made" and "halves" in found.shortcomings


def test_removed_image_points_are_counted():
    """Two inseparable ones are both removed; a coordinate of a control point is none."""
    network = SimpleNamespace(cameras=[SimpleNamespace(model="opencv")])
    removed = [SimpleNamespace(kind="image", rows=(3, 8)), SimpleNamespace(kind="X", rows=(1,))]
    given = SimpleNamespace(
        adjustment=SimpleNamespace(network=network, removed=removed),
        parameters={}, stated_sigma={}, rms=0.1,
    )  # fmt: skip
    assert "Removed as gross errors: 2 image points" in report._camera(given)


def test_cameras_with_one_folder_are_refused(tmp_path):
    given = SimpleNamespace(cameras={"a b": None, "A_b": None}, rig=None)
    with pytest.raises(InputError, match="'a b' and 'A_b' would have the same folder 'A_b'"):
        write_calibrations(given, tmp_path / "out", plots=False)
    assert not (tmp_path / "out").exists()


def test_coverage_counts_cells_and_corners():
    rng = np.random.default_rng(0)
    uv = rng.uniform([120, -0.5], [479.5, 359.5], (3000, 2))
    found = coverage(uv, (480, 360))
    assert found.counts.sum() == 3000 and found.part == pytest.approx(0.75)
    assert found.corners == {"upper left": False, "upper right": True,
                             "lower left": False, "lower right": True}  # fmt: skip
    assert found.reach == pytest.approx(1, abs=0.03)
    k, (u, v) = found.counts[3, 7], uv.T
    assert k == ((u >= 279.5) & (u < 319.5) & (v >= 119.5) & (v < 159.5)).sum()


def poses_in_words(poses, **changes):
    M, X0 = map(np.array, zip(*poses))
    full = coverage(UV.repeat(60, 0) * [1, 1], (480, 360), (3, 3))
    given = dict(position=X0, rotation=M, middle=np.array([0.12, 0.075, 0]), unit="m",
                 covered=full, rms=0.1, t={"fx": 500.0, "k1": 9.0},
                 model=get_model("opencv"))  # fmt: skip
    return advice(**(given | changes))


def test_what_is_missing_is_said():
    middle = (0.12, 0.075)
    good = [render.pose(*angles, middle, d) for *angles, d in (
        (30, 0, 0, 0.4), (-30, 0, 0, 0.6), (0, 30, 90, 0.4), (0, -30, 90, 0.6),
        (25, 20, 0, 0.5), (-25, 20, 90, 0.5), (0, 0, 0, 0.4), (0, 0, 90, 0.7),
    )]  # fmt: skip
    assert poses_in_words(good) == []
    straight = [render.pose(0, 0, 10 * i, middle, 0.4 + 0.1 * (i % 3)) for i in range(9)]
    said = poses_in_words(straight)
    assert "0 of 9 photographs look at the board from more than 15° aside" in said[0]
    unturned = [
        render.pose(30 * np.cos(i), 30 * np.sin(i), 180 * (i % 2), middle, 0.3 + 0.1 * (i % 3))
        for i in range(8)
    ]
    assert ["rolled by 90°" in text for text in poses_in_words(unturned)] == [True]
    assert poses_in_words(good, t={"fx": 2.0})[0].startswith("fx is known only to 50 %")
    near = [render.pose(*angles, middle, 0.5) for angles in (
        (30, 0, 0), (-30, 0, 0), (0, 30, 90), (0, -30, 90), (20, 20, 0), (0, 0, 0))]  # fmt: skip
    said = poses_in_words(near)
    assert "only 6 photographs" in said[0] and "nearly one distance (0.5 to 0.5 m)" in said[1]
    left = coverage(np.array([[10.0, 10], [10, 350], [470, 10]]), (480, 360))
    said = poses_in_words(good, covered=left, rms=2.0, t={"fx": 900.0, "k3": 0.4})
    assert "no point in the lower right corner" in said[0] and "cover 3 %" in said[1]
    assert "RMS 2.00 px" in said[2] and len(said) == 3
    again = [*good, *(render.pose(a + 0.5, b, c, middle, d * 1.01) for a, b, c, d in (
        (30, 0, 0, 0.4), (-30, 0, 0, 0.6), (25, 20, 0, 0.5)))]  # fmt: skip
    (said,) = poses_in_words(again)
    assert said.startswith("3 of 11 photographs repeat the pose of another")
    (said,) = often_removed(["2-1", "1-3", "1-3", "1-3", "1-3", "2-1"], 9)
    assert said.startswith("point 1-3 of the board was removed in 4 of 9 photographs")
    model, t = get_model("opencv"), {"fx": 900.0, "k3": 0.4}
    for which in (FEWER, SIGNIFICANT_ONLY):
        (suggestion,) = suggest(t, model, which)
        assert suggestion.startswith("not significant: k3 (t 0.4)")
    assert suggest(t, model, RICHER) == []


def test_photographs_that_fit_worse_than_the_others_are_named():
    rms = np.array([0.10, 0.12, 0.27, 0.11, np.nan, 0.35])
    names = [f"{k}.jpg" for k in range(6)]
    (said,) = misfitting_views(names, rms)
    assert said.startswith("'5.jpg', '2.jpg': residuals up to 2.9 times")
    assert not misfitting_views(names, np.full(6, 0.1)) and not misfitting_views(names, 0 * rms)
    assert "19 of 21 photographs are not used" in many_not_used(2, 19)[0]
    assert not many_not_used(12, 1)


def test_more_and_fewer_parameters_are_never_advised_together():
    """The rule of `report.lens_advice`: a camera that photographs hardly determine gets no more
    parameters; what a model lacks is added before significance is asked."""
    assert advise_parameters(True, True) == advise_parameters(True, False) == FEWER
    assert advise_parameters(False, True) == RICHER
    assert advise_parameters(False, False) == SIGNIFICANT_ONLY
    assert "richer" in ADVICE_ON_FIELD[RICHER] and "richer" not in ADVICE_ON_FIELD[FEWER]


def test_report_and_json_and_files(calibration, folder, tmp_path):
    report = calibration.report()
    for part in ("photo", "empty.jpg   the file is empty", "Uncertainty of a projected point",
                 "Cross-validation", "Advice", "Variance factor"):  # fmt: skip
        assert part in report
    assert max(map(len, report.splitlines())) <= 100
    (tmp_path / "out").mkdir()
    for old in ("uncertainty_far.png", "residuals_3.png", "mine.png"):
        (tmp_path / "out" / old).write_bytes(b"from somewhere else")
    with pytest.raises(InputError, match="uncertainty_far.png.*residuals_3.png: already there"):
        write_calibration(calibration, tmp_path / "out", plots=False)
    write_calibration(calibration, tmp_path / "out", plots=False, force=True)
    assert [path.name for path in (tmp_path / "out").glob("*.png")] == ["mine.png"]
    document = json.loads((tmp_path / "out" / "result.json").read_text())
    assert document["converged"] and document["redundancy"] == calibration.adjustment.redundancy
    about = document["calibration"]
    assert about["photographs"]["failed"]["empty.jpg"] == "the file is empty"
    assert about["rms"] == pytest.approx(calibration.rms)
    assert about["uncertainty"][2] == {
        "frame": "scene", "distance": None,
        "middle": pytest.approx(calibration.uncertainty().middle),
        "corners": pytest.approx(calibration.uncertainty().corners),
    }  # fmt: skip
    again = read_network(tmp_path / "out" / "network")
    removed = len(calibration.adjustment.removed)
    assert len(again.observations) == len(calibration.measured) - removed
    for camera in (read_opencv(tmp_path / "out" / "cam.yaml"),
                   *read_cameras(tmp_path / "out" / "colmap" / "cameras.txt")):  # fmt: skip
        assert camera.image_size == (480, 360)
        for name, value in calibration.camera.parameters.items():
            assert camera.parameters.get(name, 0.0) == pytest.approx(value, abs=1e-9)
    text = (tmp_path / "out" / "cam.toml").read_text()
    assert f"fx = {calibration.parameters['fx']!r}" in text and "free = []" in text
    assert "# σ of fx: 0." in text


def test_figures(calibration, tmp_path):
    axes = {}
    drawings = {
        "coverage": calibration.plot_coverage, "map": calibration.plot_uncertainty,
        "curve": calibration.plot_uncertainty_over_distance, "halves": calibration.plot_halves,
    }  # fmt: skip
    written = write_figures(tmp_path, {
        name: ((6, 5), None, lambda ax, name=name, draw=draw: axes.update({name: draw(ax=ax)}))
        for name, draw in drawings.items()
    })
    assert [path.stem for path in written] == list(drawings)
    assert axes["map"].get_ylim() == (359.5, -0.5)
    assert axes["curve"].get_xscale() == "log"
    shown = axes["coverage"].images[0].get_array()
    np.testing.assert_array_equal(shown.filled(0), calibration.coverage.counts)
    # The figures of the report lie on the curve, at the bottom of its dip too.
    curve = axes["curve"].lines[0]
    for m in calibration.reported_maps[:2]:
        place = np.flatnonzero(curve.get_xdata() == m.distance)
        np.testing.assert_allclose(curve.get_ydata()[place], m.middle, rtol=1e-9)
        assert len(place) and f"{m.middle:.3g}" in {t.get_text() for t in axes["curve"].texts}
    assert curve.get_ydata().min() <= calibration.reported_maps[0].middle
    assert axes["halves"].get_xlabel() == "u [px]" and axes["halves"].get_ylabel() == "v [px]"


def test_the_curve_over_distance_is_the_uncertainty_at_every_distance(calibration):
    """A polynomial in 1/d through three maps, against the maps themselves."""
    near = float(np.median(calibration.distances))
    for distance in (0.4 * near, 1.1 * near, 50 * near):
        found = calibration.uncertainty(distance)
        middle, corners = calibration.uncertainty_over_distance([distance])
        np.testing.assert_allclose(middle, found.middle, rtol=1e-5)
        np.testing.assert_allclose(corners, found.corners, rtol=1e-5)


def test_the_expected_difference_is_that_of_a_sample(sample):
    """Pairs of simulated calibrations, over the σ stated."""
    calibration, batch = sample
    model, C = get_model("opencv"), calibration.adjustment.camera_covariance("cam")
    names = model.parameters
    of = lambda k: (model, dict(zip(names, batch.interior[k][: len(names)].tolist())))
    ratio = []
    for k in range(0, 120, 2):
        one, other = of(k), of(k + 1)
        found = compare_cameras(one, other, image_size=(480, 360))
        expected = expected_difference(found, one, other, (C, C), image_size=(480, 360))
        ratio.append(found.length**2 / np.trace(expected, axis1=2, axis2=3))
    # the middle of the image, where the first order holds
    assert np.nanmean(np.array(ratio)[:, 8:-8, 8:-8]) == pytest.approx(1, abs=0.25)


def test_compare_tells_what_is_expected(calibration, tmp_path, monkeypatch, capsys):
    file, plot = tmp_path / "result.json", tmp_path / "map.png"
    file.write_text(json_text(calibration.to_dict(brief=True)))
    monkeypatch.setattr(
        sys, "argv", ["jaxbundle", "compare", str(file), str(file), "--plot", str(plot)]
    )
    with pytest.raises(SystemExit) as ended:
        cli.main()
    said = capsys.readouterr().out
    assert not ended.value.code and plot.stat().st_size > 10_000
    assert "expected by the σ of both" in said and "largest    expected" in said
    ((camera, (names, C)),) = read_calibrated(file)
    # that of errors which image points share: twelve views show them
    expected = calibration.adjustment.camera_covariance(calibration.name)
    assert calibration.adjustment.error_model is not None
    assert tuple(names) == tuple(expected[0]) and camera.image_size == (480, 360)
    np.testing.assert_allclose(C, expected[1], rtol=1e-9, atol=1e-20)
    for text, complaint in (("{", "not valid JSON"), ("[]", "not the result of adjust"),
                            ('{"converged": false}', "was not solved"),
                            ("[" * 100_000, "nested too deeply")):  # fmt: skip
        file.write_text(text)
        with pytest.raises(InputError, match=complaint):
            read_calibrated(file)
