"""Errors that image points share, in simulated networks: their sizes, and the σ under them."""

import dataclasses
import json
from types import SimpleNamespace

import numpy as np
import page_reader
import pytest

import jaxbundle
from jaxbundle.adjustment.problem import make_problem
from jaxbundle.adjustment.quality import correlated_errors
from jaxbundle.adjustment.quality.correlated_errors import (
    CorrelationSettings,
    cubic_splines,
    root_of_octaves,
    splines_of_point,
)
from jaxbundle.adjustment.quality.given_points import given_points_components, wendland
from jaxbundle.adjustment.quality.replication import compared_parameters
from jaxbundle.adjustment.quality.weakness import Weakness
from jaxbundle.adjustment.replicate import _difference_of_jobs
from jaxbundle.errors import NotSolvedError
from jaxbundle.leastsquares.quality import error_components
from jaxbundle.leastsquares.quality.error_effects import stack_rows
from jaxbundle.leastsquares.solution import Solution
from jaxbundle.network.subsets import keep_images
from jaxbundle.planning import grid_of_targets, ring_of_stations
from jaxbundle.report import correlated
from jaxbundle.report.layout import significant
from jaxbundle.report.page import compose

IMAGES, SIGMA = 12, 0.2
CAMERA = jaxbundle.Camera(
    "cam", "opencv", {"fx": 1500.0, "fy": 1500.0, "cx": 999.5, "cy": 749.5, "k1": -0.05},
    free=("fx", "fy", "cx", "cy", "k1", "k2"), image_size=(2000, 1500),
)  # fmt: skip


@pytest.fixture(scope="module")
def shaken(clean):
    """Adjusted with errors of photographs, the error model and halves by photographs."""
    found = jaxbundle.adjust(disturbed(clean, 5, affine=0.4), correlated=True)
    return found.with_changes(halves_by="photographs")


@pytest.fixture(scope="module")
def clean():
    stations = ring_of_stations(IMAGES, 5.0, 6.0, roll_every=2)
    targets = grid_of_targets(9, 7, 0.6, relief=0.6)
    return jaxbundle.simulate(stations, targets, CAMERA, noise=SIGMA, seed=1)


def disturbed(network, seed, affine=0.0, field=0.0):
    """Observations with an affine distortion that changes from photograph to photograph (a size at
    the edge of the measured area), and waves on the sensor, which splines only approximate."""
    rng, rays = np.random.default_rng(seed), network.observations
    low, high = rays.xy.min(0), rays.xy.max(0)
    x, y = 2 * (rays.xy - (low + high) / 2).T / (high - low).max()
    a, b = affine * rng.normal(size=(2, len(network.images)))[:, rays.image]
    phase = 3 * np.stack([x, y], 1) + rng.uniform(0, 6, 2)
    wave = np.sqrt(2) * field * np.sin(phase[:, ::-1])
    xy = rays.xy + np.stack([a * x + b * y, b * x - a * y], 1) + wave
    return network.replace(observations=dataclasses.replace(rays, xy=xy))


def test_independent_errors_leave_the_sigma_as_they_are(clean):
    result = jaxbundle.adjust(clean, correlated=True)
    assert abs(result.sigma_ratio - 1) < 0.08
    sizes = {size.name: size for size in result.error_model.sizes}
    assert all(size.score < 4 for size in sizes.values())
    assert sizes["affine by photograph"].size < 0.05


def test_sizes_are_found_and_sigma_hold(clean):
    """Differences to the truth over their σ, of several draws. Affine distortions of twice the
    noise, which change between photographs, are hardly seen in σ0: orientations absorb them."""
    true = np.array([CAMERA.parameters.get(name, 0.0) for name in CAMERA.free])
    classical, correlated, found = [], [], []
    for seed in range(10):
        result = jaxbundle.adjust(disturbed(clean, seed, affine=0.4), correlated=True)
        names, C = result.camera_covariance("cam", classical=True)
        values = result.camera_parameters("cam")
        d = np.array([values[name] for name in names]) - true
        K = result.correlated_camera_covariance("cam")
        classical.append(square(d, C) / len(d))
        correlated.append(square(d, K) / len(d))
        found.append({size.name: size.size for size in result.error_model.sizes})
    assert abs(np.median([one["affine by photograph"] for one in found]) / 0.4 - 1) < 0.2
    assert np.mean(classical) > 5
    # 60 squares, the noise of all the same: 1 ± 0.4
    assert 0.5 < np.mean(correlated) < 1.8


def square(d, C):
    scale = np.sqrt(np.diag(C))
    return d / scale @ np.linalg.solve(C / np.outer(scale, scale), d / scale)


def test_a_field_on_the_sensor_is_found(clean):
    result = jaxbundle.adjust(disturbed(clean, 3, field=0.3), correlated=True)
    sizes = {size.name: size for size in result.error_model.sizes}
    field = sizes["field on the sensor"]
    # waves are coarse, and the lens model takes up a part of them: their size is uncertain
    assert field.score > 4 and abs(field.size - 0.3) < 2.5 * field.sigma < 0.35
    told = result.to_dict()
    json.dumps(told, allow_nan=False)
    assert {c["name"] for c in told["error_components"]} == set(sizes)
    f = told["cameras"]["cam"]["parameters"]["fx"]
    assert f["sigma_correlated"] >= 0.9 * f["sigma"]
    assert "sigma_correlated" in told["images"][clean.images.id[0]]["X0"]
    assert "Correlated errors" in result.report()
    assert len(result.to_pandas("cameras")["sigma_correlated"])
    of_field = lambda: next(line for line in correlated.remarks(result) if "a field of" in line)
    assert "a richer lens model may" in of_field() and "ewer" not in " ".join(result.warnings)
    # a camera that the photographs hardly determine gets no further parameters
    vars(result)["weakness"] = Weakness(("fx of camera cam",), 0.07)
    assert "Free fewer camera parameters" in " ".join(result.warnings)
    assert "richer" not in of_field() and "no further parameters" in of_field()
    del vars(result)["weakness"]


def test_halves_show_what_classical_sigma_lack(clean, shaken):
    plain = jaxbundle.replicate(clean, by="photographs", repeat=3)
    assert 0.2 < plain.ratio < 2.2 and abs(plain.ratio_correlated / plain.ratio - 1) < 0.3
    found = jaxbundle.replicate(shaken, by="photographs", repeat=3)
    assert found.ratio > 4 and 0.3 < found.ratio_correlated < 2.2
    assert len(found.table()["parameter"]) == 3 * len(CAMERA.free)
    assert found.splits[0].d2 == pytest.approx(shaken.replication.d2)
    by_points = jaxbundle.replicate(clean, by="points")
    assert by_points.dof == len(CAMERA.free)


@pytest.mark.further
def test_a_half_is_that_of_its_image_points_alone(shaken):
    """A network of every other photograph, adjusted from its own start values."""
    network = shaken.network
    second = network.observations.image % 4 < 2  # both rolled and not
    found = shaken.compare_halves(second)
    halves = [keep_images(network, np.arange(IMAGES) % 4 // 2 == 1 - k) for k in (0, 1)]
    alone = [jaxbundle.adjust(half) for half in halves]
    values = [[one.camera_parameters("cam")[name] for _, name in found.names] for one in alone]
    sigma = np.sqrt(np.diag(found.classical))
    np.testing.assert_allclose(found.difference / sigma, np.subtract(*values) / sigma, atol=0.1)
    # independent halves: the sum of both covariances, with the σ0 of the whole
    Q = sum(one.camera_cofactor("cam")[1] for one in alone)
    np.testing.assert_allclose(sigma, shaken.sigma0 * np.sqrt(np.diag(Q)), rtol=0.03)


def test_report_and_page_show_components_sigma_and_halves(shaken):
    """The σ shown first is the larger one; halves are in the first lines."""
    html = "".join(compose(shaken))
    shown = "".join(t for texts in page_reader.Page(html).texts.values() for t in texts)
    text = shaken.report()
    in_one_line = lambda lines: " ".join(lines.split())
    times = f"differ by {np.sqrt(shaken.replication.ratio):.2f} classical σ"
    assert times in in_one_line(text.partition("Counts")[0]) and times in in_one_line(str(shaken))
    assert "σ0" in str(shaken) and "Correlated errors" in text and "Replication" in text
    for size in shaken.error_model.sizes:
        assert size.name in shown
    assert times in shown and shaken.replication.sentence in shown
    f = shaken.cameras["cam"]["parameters"]["fx"]
    assert f["sigma_correlated"] > 1.5 * f["sigma"]
    for column, name in (("sigma", "sigma_correlated"), ("classical", "sigma")):
        assert page_reader.column(html, "cameras", column)[0] == pytest.approx(f[name], rel=1e-5)
    about = [finding.about for finding in shaken.verdict.findings if finding.state != "met"]
    assert "Correlated errors" in about


def test_chi_squared_confirms_no_sigma_where_errors_are_shared(shaken):
    network = shaken.network
    stated = dataclasses.replace(
        network.observations,
        sigma=network.observations.sigma * shaken.sigma0, sigma_origin="stated",
    )  # fmt: skip
    found = jaxbundle.adjust(network.replace(observations=stated), correlated=True)
    assert found.global_test()["passed"]
    words = " ".join(found.report().split())
    assert "confirmed" not in words and "does not show errors that observations share" in words


def test_a_saved_result_keeps_error_model_and_halves(shaken, tmp_path, monkeypatch):
    shaken.save(tmp_path / "a.npz")
    again = jaxbundle.load_adjustment(tmp_path / "a.npz")
    monkeypatch.setattr(error_components, "fit_error_model", None)  # nothing is estimated again
    assert again.report() == shaken.report()
    told = [json.dumps(one.to_dict()) for one in (shaken, again)]
    assert told[0] == told[1] and json.loads(told[0])["replication"]["by"] == "photographs"
    name = ("camera", "cam", "fx")
    function = lambda values: values["camera"][0, :2]
    modelled = [one.covariance_of(function) for one in (shaken, again)]
    np.testing.assert_allclose(*modelled, rtol=1e-9)
    f = shaken.cameras["cam"]["parameters"]["fx"]
    assert np.sqrt(modelled[0][0, 0]) == pytest.approx(f["sigma_correlated"], rel=1e-6)
    assert np.sqrt(shaken.covariance(name)[0, 0]) == pytest.approx(np.sqrt(modelled[0][0, 0]))
    assert np.sqrt(shaken.covariance(name, classical=True)[0, 0]) == pytest.approx(f["sigma"])


@pytest.mark.further
def test_comparisons_use_sigma_under_correlated_errors(clean, shaken, tmp_path):
    """Of two sessions with errors of photographs, which classical σ call different."""
    other = jaxbundle.adjust(disturbed(clean, 6, affine=0.4), correlated=True)
    plain = [jaxbundle.adjust(one.network) for one in (shaken, other)]
    with_model, without = jaxbundle.compare(shaken, other), jaxbundle.compare(*plain)
    camera = with_model.kind == "camera"
    C = [one.camera_covariance("cam")[1] for one in (shaken, other)]
    np.testing.assert_allclose(with_model.sigma[camera] ** 2, np.diag(sum(C)), rtol=0.1)
    assert with_model.modelled == ("a", "b") and not without.modelled
    assert with_model.tests["camera cam"].f < without.tests["camera cam"].f / 3
    files = []
    for number, one in enumerate((shaken, other)):
        files.append(tmp_path / f"{number}.json")
        files[-1].write_text(json.dumps(one.to_dict(brief=True)))
    found = jaxbundle.stability(files)
    np.testing.assert_allclose(found.sigma[0] ** 2, np.diag(C[0]), rtol=1e-9)
    d = np.subtract(
        *[[one.camera_parameters("cam")[n] for n in found.names] for one in (shaken, other)]
    )
    assert found.all_parameters.chi2 == pytest.approx(square(d, sum(C)), rel=1e-6)


def test_only_free_parameters_are_compared(clean):
    """Held parameters between free ones: columns of unknowns are not those of values."""
    free = ("fx", "fy", "k2", "p2")
    held = clean.replace(cameras=(dataclasses.replace(CAMERA, free=free),))
    problem = make_problem(held)
    both = [np.arange(len(problem.image)) % 2 == k for k in (0, 1)]
    names = compared_parameters(problem, both)
    assert [name for _, name, _ in names] == list(free)
    assert [k for *_, (_, _, k) in names] == [0, 1, 2, 3]


def test_what_cannot_be_replicated_is_said(clean):
    with pytest.raises(jaxbundle.InputError, match="did you mean 'photographs'|photographs"):
        jaxbundle.replicate(clean, by="photograph")
    held = clean.replace(cameras=(dataclasses.replace(CAMERA, free=()),))
    with pytest.raises(jaxbundle.InputError, match="no camera has a free parameter"):
        jaxbundle.replicate(held)


def test_splines_are_a_partition_of_one_and_kernels_are_positive():
    rng = np.random.default_rng(0)
    place = np.append(rng.uniform(0, 1, 200), [0.0, 0.25, 1.0])
    B, at = cubic_splines(place, 11), np.arange(len(place))[:, None]
    np.testing.assert_allclose(B.sum(1), 1, atol=1e-12)
    values, which = splines_of_point(place, 11)
    sparse = np.zeros_like(B)
    sparse[at, which] = values
    np.testing.assert_allclose(sparse, B, atol=1e-12)
    # the finest splines, combined, have the covariance of the splines of all octaves
    settings = CorrelationSettings()
    u, v = rng.uniform(0, 1, (2, 50))
    by_octave = [
        np.einsum("ni,nj->nji", cubic_splines(u, a), cubic_splines(v, b)).reshape(50, -1)
        for a, b in settings.octaves_of_knots
    ]
    finest = by_octave[0] @ root_of_octaves(settings)
    np.testing.assert_allclose(finest @ finest.T, sum(B @ B.T for B in by_octave), atol=1e-12)
    X = rng.normal(size=(40, 3))
    K = wendland(np.linalg.norm(X[:, None] - X, axis=2))
    assert np.linalg.eigvalsh(K).min() > 0 and wendland(np.array([0.0, 1.0, 2.0])).sum() == 1


def test_everything_that_states_a_sigma_asks_the_error_model(shaken):
    """Blocks, functions, the error budget and designs with the sizes that were found agree."""
    f = shaken.cameras["cam"]["parameters"]["fx"]
    blocks = shaken.camera_covariance("cam")[1], shaken.camera_covariance("cam", classical=True)[1]
    np.testing.assert_allclose(
        [f["sigma_correlated"], f["sigma"]], [np.sqrt(C[0, 0]) for C in blocks]
    )
    # what is significant is so by the σ that is shown
    assert f["t"] == pytest.approx(f["value"] / max(f["sigma"], f["sigma_correlated"]))
    names = [("image", shaken.network.images.id[2], name) for name in ("X0", "Y0", "kappa")]
    C = shaken.covariance(*names, classical=True)
    np.testing.assert_allclose(
        C, shaken.classical_image_covariance[2][np.ix_([0, 1, 5], [0, 1, 5])], rtol=1e-6
    )
    # blocks are from reduced matrices, functions from solutions of the normal equations
    C = np.sqrt(np.diag(shaken.covariance(*names)))
    of_image = np.sqrt(np.diagonal(shaken.image_covariance[2]))[[0, 1, 5]]
    np.testing.assert_allclose(C, of_image, rtol=1e-6)
    assert (C > 1.5 * np.sqrt(np.diag(shaken.covariance(*names, classical=True)))).any()
    budget = jaxbundle.sensitivity(shaken, {"camera:cam:k3": 1e-3}, of="camera:cam:fx")
    np.testing.assert_allclose(budget.sigma, f["sigma_correlated"], rtol=1e-6)
    sizes = {size.name: size.size for size in shaken.error_model.sizes}
    start = dataclasses.replace(shaken.problem.data, start=shaken.values)
    design = jaxbundle.precision(shaken.problem, start, names=(names[0],), errors=sizes)
    # a design knows its sizes, which the adjustment has estimated
    known = shaken.error_model.as_estimated
    of_image = np.sqrt(known.covariance("image")[2][0, 0])
    # the places of image points are those of the design, without residuals
    np.testing.assert_allclose(np.sqrt(design.covariance[0, 0]), of_image, rtol=1e-3)
    of_camera = np.sqrt(known.covariance("camera")[0][0, 0])
    np.testing.assert_allclose(design.cameras[0, 0], of_camera, rtol=1e-3)
    assert of_image < C[0] and of_camera < f["sigma_correlated"]
    with pytest.raises(jaxbundle.InputError, match="no component principal"):
        jaxbundle.precision(shaken.problem, start, errors={"principal": 0.1})


@pytest.mark.further
def test_errors_of_given_points_are_found(clean):
    """Columns are the changes of residuals if held points move; with displaced points the component
    is found in its size, and the principal distance is off by more than classical σ."""
    points = dataclasses.replace(clean.points, role=("fixed",) * len(clean.points))
    given = clean.replace(points=points, datum="control")
    found = jaxbundle.adjust(given, correlated=True)
    solution, rays = found.cofactors.solution, found.problem
    row = 2 * np.arange(len(clean.observations))
    sigma = clean.observations.sigma
    of_plane, across = given_points_components(solution, row, rays.point, sigma, 0, 8)
    X = np.asarray(solution.values["point"])
    # the normal of the plane that fits best: of the smallest second moment
    centred = X - X.mean(0)
    normal = np.linalg.eigh(centred.T @ centred)[1][:, 0]
    step = np.zeros((len(points), 3))
    step[7] = 1e-5 * normal
    moved = Solution(solution.problem, solution.values | {"point": X + step})
    change = stack_rows(moved, moved.residuals) - stack_rows(solution, solution.residuals)
    column = across.root.toarray()[:, 7]
    scale = column @ change / (column @ column)
    np.testing.assert_allclose(change, scale * column, atol=1e-4 * np.abs(change).max())
    assert of_plane.root.shape[1] == 2 * len(points)
    assert not given_points_components(solution, row, rays.point, sigma, 0, len(points) + 1)
    assert max(size.size for size in found.error_model.sizes[-2:]) < 0.1
    rng = np.random.default_rng(2)
    off = points.position + 0.003 * rng.normal(size=X.shape)
    wrong = given.replace(points=dataclasses.replace(points, position=off))
    displaced = jaxbundle.adjust(wrong, correlated=True)
    sizes = displaced.error_model.sizes[-2:]
    said = " ".join(correlated.remarks(displaced))
    assert "displaced in its plane" in said and "out of its plane" in said
    assert [size.name for size in sizes] == ["given points in plane", "given points out of plane"]
    # 3 mm at 6 m are 0.75 pixels across the line of sight; of the three axes two thirds of that
    # square, 0.61 pixels, in both components together
    total = np.sqrt(sum(size.size**2 for size in sizes))
    assert 0.5 < total < 0.75 and max(size.score for size in sizes) > 20


@pytest.mark.further
def test_errors_across_a_board_are_told_from_those_in_its_plane(clean):
    """A board that is bent, or one whose print is displaced: the component of the other is
    small."""
    rng = np.random.default_rng(5)
    stations = ring_of_stations(IMAGES, 5.0, 6.0, roll_every=2)
    targets = grid_of_targets(9, 7, 0.6)
    exact = jaxbundle.simulate(stations, targets, CAMERA, noise=SIGMA, seed=1)
    flat = exact.points.position * np.array([1.0, 1.0, 0.0])
    points = dataclasses.replace(exact.points, position=flat, role=("fixed",) * len(flat))
    given = exact.replace(points=points, datum="control")
    # 3 mm at 7.8 m are 0.58 pixels; of an error across the plane, seen at 40°, sin 40° of that in
    # both coordinates together; in the plane of two errors of 1 and cos 40°
    across, within = 0.58 * 0.64 / np.sqrt(2), 0.58 * np.sqrt((1 + 0.77**2) / 2)
    for axes, large, small, size in (([0, 0, 1], -1, -2, across), ([1, 1, 0], -2, -1, within)):
        off = flat + 0.003 * rng.normal(size=flat.shape) * np.array(axes)
        wrong = given.replace(points=dataclasses.replace(given.points, position=off))
        sizes = jaxbundle.adjust(wrong, correlated=True).error_model.sizes
        assert sizes[large].size == pytest.approx(size, rel=0.3), axes
        assert sizes[small].size < 0.3 * sizes[large].size, axes


@pytest.mark.further
def test_too_few_photographs_for_halves():
    """The remedy that is named can be followed."""
    targets = grid_of_targets(9, 7, 0.6, relief=0.6)
    first = lambda number: jaxbundle.simulate(
        ring_of_stations(number, 5.0, 6.0, roll_every=2), targets, CAMERA, noise=SIGMA, seed=1
    )
    with pytest.raises(jaxbundle.InputError, match="4 photographs: .* 6 or more; .* points need 3"):
        jaxbundle.replicate(first(4), by="photographs")
    with pytest.raises(jaxbundle.InputError, match="2 photographs: halves by points need 3"):
        jaxbundle.replicate(first(2), by="points")


@pytest.mark.further
def test_check_points_share_the_errors_of_the_network():
    """One by one, the errors of a component displace network and check points: the sum of squares
    is the covariance of a model with this component alone. Without distortion, by which errors of
    measured coordinates are magnified in residuals of corrected ones."""
    stations = ring_of_stations(IMAGES, 5.0, 6.0, roll_every=2)
    targets = grid_of_targets(9, 7, 0.6, relief=0.6)
    camera = dataclasses.replace(CAMERA, parameters=CAMERA.parameters | {"k1": 0.0})
    clean = jaxbundle.simulate(stations, targets, camera, noise=SIGMA / 200, seed=1)
    role = np.array(clean.points.role, dtype=object)
    role[[10, 40]] = "check"
    given = clean.replace(points=dataclasses.replace(clean.points, role=tuple(role)))
    result = jaxbundle.adjust(given, correlated=True)
    model, size = result.error_model, 0.1  # far above what is left by the end of iterations
    theta = np.zeros(len(model.theta))
    number = [c.name for c in model.components].index("principal point by photograph")
    theta[1 + number] = size**2
    result.keep(dataclasses.replace(model, theta=theta), None)
    found = result.check_points
    rays, squares = given.observations, np.zeros((2, 3, 3))
    for image in range(IMAGES):
        for axis in (0, 1):
            xy = rays.xy.copy()
            xy[rays.image == image, axis] += size
            moved = given.replace(observations=dataclasses.replace(rays, xy=xy))
            d = jaxbundle.adjust(moved).check_points.position - found.position
            squares += d[:, :, None] * d[:, None]
    np.testing.assert_allclose(
        np.sqrt(np.diagonal(found.covariance, axis1=1, axis2=2)),
        np.sqrt(np.diagonal(squares, axis1=1, axis2=2)),
        rtol=0.02,
    )


def test_the_band_of_replication_is_that_of_the_model(clean, shaken):
    """Its simulated halves have d²/n about 1, more widely with sizes estimated from few
    photographs."""
    for given in (clean, shaken):
        found = jaxbundle.replicate(given, by="photographs", repeat=2)
        low, high = found.band
        assert 0.1 < low < 0.9 and 1.1 < high < 5
        told = found.to_dict()
        np.testing.assert_allclose(told["expected"], [found.dof * low, found.dof * high])
        assert f"{low:.2f} to {high:.2f}" in str(found)
        assert f"{np.sqrt(low):.2f} to {np.sqrt(high):.2f} expected" in found.sentence
        assert {"name", "sigma", "unit", "score"} < set(told["error_components"][1])


def test_what_components_mean_is_said(shaken):
    (said,) = [line for line in correlated.remarks(shaken) if "shear" in line]
    size = next(s for s in shaken.error_model.sizes if s.name.startswith("affine"))
    assert f"{significant(size.size, 2)} px" in said
    assert said in " ".join(shaken.report().split())
    assert any(said in finding.words for finding in shaken.verdict.findings)
    told = {c["name"]: c for c in shaken.to_dict(brief=True)["error_components"]}
    assert told[size.name]["sigma"] == size.size and told[size.name]["unit"] == "px"


def test_components_that_chance_explains_are_left_out(clean):
    equations = jaxbundle.adjust(clean, correlated=True).error_model.equations
    # Šidák's level of five components
    assert equations.critical == pytest.approx(2.319, abs=1e-3)
    rng, T = np.random.default_rng(0), equations.T
    # normal forms: mean T_0, covariance 2·T, no skewness
    equations = dataclasses.replace(equations, cubes=None)
    forms = T[:, 0] + rng.normal(size=(300, len(T))) @ np.linalg.cholesky(2 * T).T
    share = np.mean([(equations.solve(q)[0][1:] > 0).any() for q in forms])
    # 5 % of components that share nothing; these do, and are left out one after the other
    assert 0.01 < share < 0.15


def test_jobs_of_cameras_of_different_models_are_not_compared():
    """k1 of one is not k1 of the other."""
    jobs = [
        SimpleNamespace(problem=SimpleNamespace(network=SimpleNamespace(
            cameras=[jaxbundle.Camera("cam", model, {}, ("k1",))]
        )))
        for model in ("opencv", "kannala-brandt")
    ]  # fmt: skip
    with pytest.raises(NotSolvedError, match="'cam' is of model opencv, .* kannala-brandt"):
        _difference_of_jobs(*jobs)


@pytest.mark.further
def test_finished_jobs_of_one_camera_are_compared(clean, shaken, tmp_path):
    """A result, a saved one and a network; another principal point in one of them is seen."""
    rays = clean.observations
    moved = clean.replace(observations=dataclasses.replace(rays, xy=rays.xy + [30.0, 0.0]))
    adjusted = jaxbundle.adjust(disturbed(moved, 6, affine=0.4))
    shaken.save(tmp_path / "first.npz")
    found = jaxbundle.replicate([tmp_path / "first.npz", adjusted, disturbed(clean, 7, affine=0.4)])
    assert found.by == "jobs" and len(found.splits) == 3 and found.dof == len(CAMERA.free)
    first = found.splits[0]
    k = first.names.index(("cam", "cx"))
    assert abs(first.difference[k] - 30) < 4 * first.sigma_correlated[k]
    assert abs(first.difference[k]) > 5 * first.sigma_correlated[k]
    same = found.splits[1]
    assert same.d2_correlated / len(same.names) < 3 < same.d2 / len(same.names)
    C = [one.camera_covariance("cam")[1] for one in (shaken, adjusted.with_correlated_errors())]
    np.testing.assert_allclose(first.correlated, sum(C), rtol=1e-6)
    assert "several jobs differ by" in found.sentence
    assert "Jobs of one camera: 3 pairs" in str(found)


@pytest.mark.parametrize("spread", [0.0, 1e-9, 1e-3])
def test_tracks_of_photographs_of_one_station_have_a_root(spread):
    """Photographs turned on a tripod: correlations of 1, and a singular block for every track."""
    rng, images, points = np.random.default_rng(0), 60, 3
    image, point = np.divmod(np.arange(images * points), points)
    row = 2 * np.arange(len(image))
    nothing = np.zeros((len(image), 2))
    rays = correlated_errors.ImageRows(
        row, image, point, 0 * image, nothing, 1 + nothing, 2 * len(image)
    )
    station = spread * rng.normal(size=(images, 3))
    scene = correlated_errors.StationsAndPoints(station, rng.normal(size=(points, 3)) + [0, 0, 9])
    root = correlated_errors._along_tracks(rays, scene, 0.6).root
    V = (root @ root.T).toarray()
    first = row[point == 0]
    np.testing.assert_allclose(V[np.ix_(first, first)], np.ones((images, images)), atol=1e-5)
    assert not V[np.ix_(first, first + 1)].any() and not V[np.ix_(first, row[point == 1])].any()


@pytest.mark.parametrize("number", [4, 5, 7, 11])
def test_squares_of_splines_are_a_cubic_in_every_interval(number):
    place = np.linspace(0, 1, 301)
    expected = np.sum(cubic_splines(place, number) ** 2, 1)
    found = correlated_errors.squares_of_splines(place, number)
    np.testing.assert_allclose(found, expected, rtol=1e-13)
