"""`adjust` around the solver: blunders, variance components, elimination, check points, names."""

import dataclasses
import json
from functools import partial

import numpy as np
import pytest

import jaxbundle
from jaxbundle import Camera
from jaxbundle.adjustment.adjust import adjust
from jaxbundle.errors import NotSolvedError
from jaxbundle.io.results import result_json
from jaxbundle.io.results.result_json import result_dict, result_text, without_nan
from jaxbundle.io.text import csv_tables
from jaxbundle.leastsquares.problem import with_data
from jaxbundle.leastsquares.quality.distributions import tau_quantile
from jaxbundle.leastsquares.quality.null_space import undetermined_unknowns
from jaxbundle.leastsquares.solution import find_minimum
from jaxbundle.network.tables import EXTERIOR

SIGMA = 0.002
TRUE = {"c": 24.0, "x0": 0.05, "y0": -0.03, "K1": 1.2e-4}
CONTROL = (0, 4, 20, 24, 62, 100, 124)
CHECK = (2, 12, 50, 74, 110)


def simulated(seed):
    """Eight convergent images around a box of 125 points, seven of them control, five check."""
    stations = jaxbundle.ring_of_stations(8, 6.0, 3.0, look_at=(0.0, 0.0, 0.5), roll_every=2)
    axis = np.linspace(-1, 1, 5)
    targets = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), -1).reshape(-1, 3)
    camera = Camera("cam", "brown", TRUE, free=("c", "x0", "y0", "K1", "K2", "P1"))
    return jaxbundle.simulate_with_truth(
        stations, targets, camera, noise=SIGMA, seed=seed, datum="control", control=CONTROL,
        control_sigma=0.002, check=CHECK, disturb=0.01,
    )  # fmt: skip


@pytest.fixture(scope="module")
def simulation():
    return simulated(4)


@pytest.fixture(scope="module")
def result(simulation):
    return adjust(simulation.network)


def with_xy(network, rows, shift):
    xy = network.observations.xy.copy()
    xy[rows] += shift
    return network.replace(observations=dataclasses.replace(network.observations, xy=xy))


def test_sigma0_is_one_and_redundancy_adds_up(result):
    spread = 1 / np.sqrt(2 * result.redundancy)
    assert abs(result.sigma0 - 1) < 4 * spread
    assert result.residuals["r"].sum() == pytest.approx(result.redundancy, abs=1e-6)
    total = sum(c.redundancy for c in result.variance_components.values())
    assert total == pytest.approx(result.redundancy, abs=1e-6)
    assert result.global_test(0.001)["passed"]


def test_parameters_are_within_their_sigma(result):
    for name, entry in result.cameras["cam"]["parameters"].items():
        if entry["free"]:
            assert abs(entry["value"] - TRUE.get(name, 0.0)) < 4 * entry["sigma"]


def test_check_points_agree_within_their_sigma(result, simulation):
    """Intersected points against their exact coordinates: mean square of d/σ near 1."""
    checks = result.table("checks")
    assert list(checks["id"]) == [str(k + 1) for k in CHECK]
    normalised = np.concatenate([checks[f"d{a}"] / checks[f"s{a}"] for a in "XYZ"])
    # 15 values: the mean square lies within 0.3 and 2.2 with 99.8 % (χ² of 15), points alike
    assert 0.2 < np.mean(normalised**2) < 2.5
    assert not set(result.points["id"]) & set(checks["id"])


def test_covariance_by_name_is_that_of_the_tables(result):
    image = result.images["id"][0]
    names = [("camera", "cam", "c"), ("image", image, "kappa"), ("point", "8", "Z")]
    covariance = result.covariance(*names)
    sigma = np.sqrt(np.diagonal(covariance))
    points = result.points
    expected = [
        result.cameras["cam"]["parameters"]["c"]["sigma"],
        result.images["skappa"][0] / result.angle_scale,
        points["sZ"][list(points["id"]).index("8")],
    ]
    assert sigma == pytest.approx(expected, rel=1e-9)


def test_covariance_of_a_function(result):
    """The variance of a sum of two coordinates is the sum of the block."""
    a, b = ("point", "8", "X"), ("point", "9", "Y")
    block = result.covariance(a, b)
    ids = list(result.points["id"])
    i, j = ids.index("8"), ids.index("9")
    total = result.covariance_of(lambda v: v["point"][i, 0] + v["point"][j, 1])
    assert total[0, 0] == pytest.approx(block.sum(), rel=1e-9)


def test_snooping_finds_the_blunders_and_nothing_else(simulation):
    network = simulation.network
    check = np.isin(network.observations.point, CHECK)
    rows = np.flatnonzero(~check)[[10, 200, 400]]
    spoilt = with_xy(network, rows, [30 * SIGMA, -20 * SIGMA])
    found = adjust(spoilt, snooping="pope")
    ids = lambda row: (
        network.points.id[network.observations.point[row]],
        network.images.id[network.observations.image[row]],
    )
    expected = {"point {} in image {}".format(*ids(row)) for row in rows}
    names = {r.name for r in found.removed}
    assert names == expected  # anything else with a probability of 0.1 %
    clean = adjust(network)
    assert found.redundancy == clean.redundancy - 2 * len(names)
    for name, entry in clean.cameras["cam"]["parameters"].items():
        if entry["free"]:
            value = found.cameras["cam"]["parameters"][name]["value"]
            assert abs(value - entry["value"]) < entry["sigma"]
    of_one = 1 - (1 - 0.001) ** (1 / clean.counts.observations)
    assert min(r.test for r in found.removed) > tau_quantile(1 - of_one / 2, clean.redundancy)


def test_elimination_fixes_what_is_insignificant(simulation):
    """K2 and P1 are zero in truth: t < 2 with 95 %; K1 is not."""
    found = adjust(simulation.network, eliminate=True)
    eliminated = {name.parameter for name in found.eliminated}
    assert "K1" not in eliminated
    for name, entry in found.cameras["cam"]["parameters"].items():
        if name in eliminated:
            assert entry["value"] == 0 and not entry["free"]
        elif entry["free"] and name not in ("c", "x0", "y0"):
            assert entry["t"] >= 2
    before = adjust(simulation.network)
    assert found.redundancy == before.redundancy + len(eliminated)


@pytest.fixture(scope="module")
def estimated():
    """Variance components estimated from σ given right, and given wrong: those of the image
    coordinates 500 times too large, those of the control points half."""
    network = simulated(7).network
    wrong = network.replace(
        observations=dataclasses.replace(
            network.observations, sigma=500 * network.observations.sigma
        ),
        points=dataclasses.replace(network.points, sigma=0.5 * network.points.sigma),
    )
    return [adjust(n, estimate_components=True) for n in (network, wrong)]


def test_variance_components_are_estimated(estimated):
    """Whatever σ were given, the estimate is the same, and near the truth."""
    right, wrong = estimated
    sigma = wrong.residuals["sigma"]
    image = wrong.residuals["kind"] == "image"
    # the component of 800 coordinates is known to 1/√(2·800) = 2.5 %, of 21 to about 20 %
    assert sigma[image] == pytest.approx(np.full(image.sum(), SIGMA), rel=0.1)
    control = sigma[wrong.residuals["kind"] == "control"]
    assert len(control) == 21 and (control > 0.001).all() and (control < 0.004).all()
    np.testing.assert_allclose(sigma, right.residuals["sigma"], rtol=0.02)
    assert wrong.sigma0 == pytest.approx(1.0, abs=0.05)
    assert wrong.warnings == ()


def test_what_was_estimated_is_told(estimated, result):
    right, wrong = estimated
    assert set(wrong.sigma_factors) == {
        "image coordinates", *(f"control points in {axis}" for axis in "XYZ")
    }
    for name, factor in wrong.sigma_factors.items():
        given = 500 if name == "image coordinates" else 0.5
        assert factor == pytest.approx(right.sigma_factors[name] / given, rel=0.02)
        component = wrong.variance_components[name]
        assert component.sigma == pytest.approx(factor, rel=2e-3)
        assert component.given == pytest.approx((given * 0.002, given * 0.002), rel=1e-9)
        assert component.estimated[0] == pytest.approx(component.sigma * component.given[0])
    assert result.sigma_factors == {} and result.global_test()["passed"]
    assert wrong.global_test()["passed"] is None
    for text in (wrong.report(), str(wrong)):
        assert "confirmed" not in text and "passed" not in text and "were estimated" in text
    told = result_dict(wrong, brief=True)["sigma_factors"]
    assert told == wrong.sigma_factors


def test_check_points_have_the_sigma_of_the_estimated_weights(estimated):
    right, wrong = (found.table("checks") for found in estimated)
    for axis in "XYZ":
        np.testing.assert_allclose(wrong[f"s{axis}"], right[f"s{axis}"], rtol=0.02)


def test_components_that_do_not_settle_are_told(simulation, monkeypatch):
    for module in ("leastsquares.quality.variance_components", "adjustment.readjust"):
        monkeypatch.setattr(f"jaxbundle.{module}.ROUNDS", 1)
    network = simulation.network
    observations = dataclasses.replace(
        network.observations, sigma=2 * network.observations.sigma
    )
    found = adjust(network.replace(observations=observations), estimate_components=True)
    assert any("did not converge in 1 rounds (" in warning for warning in found.warnings)
    assert found.sigma_factors["image coordinates"] != 1


def test_exact_observations_have_no_components(simulation):
    """Residuals that are rounding keep their weights, and the result says so."""
    exact = adjust(simulation.truth, estimate_components=True)
    assert exact.converged and exact.sigma_factors == {}
    assert any("image coordinates fit exactly" in warning for warning in exact.notes)


def test_gauss_newton_finds_the_same_minimum(simulation, result):
    other = adjust(simulation.network, method="gauss-newton")
    assert other.converged
    assert other.vtpv == pytest.approx(result.vtpv, rel=1e-10)


@pytest.mark.further
def test_gauss_newton_that_strays_is_not_taken_for_a_minimum(simulation):
    """It may end in another minimum, or not at all, but never where vᵀPv could still fall."""
    rng = np.random.default_rng(0)
    points = simulation.network.points
    for size in (0.3, 1.0):
        moved = points.position + size * rng.uniform(-1, 1, points.position.shape)
        network = simulation.network.replace(points=dataclasses.replace(points, position=moved))
        found = adjust(network, method="gauss-newton")
        if found.converged:
            again = find_minimum(found.problem, found.values, max_steps=101)
            lowest = 2 * np.nanmin(again.history.cost)
            assert found.vtpv == pytest.approx(lowest, rel=1e-8)


def test_what_is_not_solved_has_no_values(simulation):
    found = adjust(simulation.network, max_iterations=1)
    assert not found.converged and "limit" in found.termination
    for ask in (lambda: found.sigma0, lambda: found.images, lambda: found.cameras):
        with pytest.raises(NotSolvedError, match="did not converge"):
            ask()


@pytest.mark.further
def test_a_wild_coordinate_ends_without_a_result(simulation):
    found = adjust(with_xy(simulation.network, [7], 1e10))
    assert not found.converged and "Not solved" in found.report()


def test_numbers_that_overflow_have_no_names(result):
    problem = result.problem
    data = problem.with_image_weights(problem.data, 1e200 * problem.data.weight["image"])
    problem = with_data(problem, data)
    assert undetermined_unknowns(problem, problem.data.start) == []


@pytest.mark.further
def test_an_undetermined_parameter_is_named():
    """Vertical images of a plane: the principal distance and the heights are not separable."""
    stations = jaxbundle.aerial_block(
        2, 3, height=100.0, footprint=(60.0, 60.0), forward_overlap=0.6, side_overlap=0.3
    )
    targets = jaxbundle.grid_of_targets(9, 9, 10.0)
    camera = Camera("cam", "brown", {"c": 50.0}, free=("c",))
    corners = [0, 8, 72, 80]
    network = jaxbundle.simulate(
        stations, targets, camera, noise=0, seed=0, datum="control", control=corners,
        image_format=(30.0, 30.0),
    )  # fmt: skip
    found = adjust(network)
    assert not found.converged
    assert found.undetermined
    assert any(name.startswith(("c of camera cam", "Z0 of image")) for name in found.undetermined)


def test_angles_come_back_on_the_branch_they_were_given(simulation, result):
    """(ω, φ, κ), a turn more, and (ω + π, π − φ, κ + π) are one rotation: one σ each, same v."""
    images = simulation.network.images
    angles = images.angles.copy()
    angles[0] += [2 * np.pi, 0, 0]
    angles[1] = [angles[1, 0] + np.pi, np.pi - angles[1, 1], angles[1, 2] - np.pi]
    other = adjust(
        simulation.network.replace(images=dataclasses.replace(images, angles=angles))
    )
    assert np.abs(other.image_values[:2, 3:] - angles[:2]).max() < 0.1
    for name in ("omega", "phi", "kappa"):
        np.testing.assert_allclose(other.images[f"s{name}"], result.images[f"s{name}"], rtol=1e-6)
    assert other.vtpv == pytest.approx(result.vtpv, rel=1e-9)
    names = ("X0", "phi", "kappa")
    columns = [EXTERIOR.index(name) for name in names]
    for i, sign in ((0, 1), (1, -1)):
        image = images.id[i]
        block = other.covariance(*(("image", image, name) for name in names))
        np.testing.assert_allclose(
            block, other.image_covariance[i][np.ix_(columns, columns)], rtol=1e-7, atol=1e-20
        )
        before = result.image_covariance[i][np.ix_(columns, columns)]
        assert block[0, 1] == pytest.approx(sign * before[0, 1], rel=1e-6)


@pytest.mark.parametrize("name, said", [
    (("camera", "cam2", "c"), "there is no camera 'cam2'; did you mean 'cam'"),
    (("camera", "cam", "K9"), "there is no camera parameter 'K9'; known: c, x0, y0, K1"),
    (("image", "777", "phi"), "there is no image '777'"),
    (("image", "1", "Phi"), "there is no image parameter 'Phi'; did you mean 'phi'"),
    (("point", "x", "X"), "there is no point 'x'"),
    (("point", "8", "x"), "there is no coordinate 'x'; did you mean 'X'"),
    (("station", "8", "X"), "a .camera., an .image. or a .point., not of .station."),
])  # fmt: skip
def test_an_unknown_of_no_such_name(result, name, said):
    with pytest.raises(KeyError, match=said):
        result.covariance(name)


@pytest.mark.parametrize("portion", [7, 10_000])
@pytest.mark.parametrize("brief", [False, True])
def test_json_text_in_pieces_is_that_of_the_whole(result, monkeypatch, portion, brief):
    in_portions = partial(csv_tables.take_portions, portion=portion)
    monkeypatch.setattr(result_json, "take_portions", in_portions)
    text = "".join(result_text(result, brief))
    assert json.loads(text) == without_nan(result_dict(result, brief))
    assert text.endswith("}\n") and text.count("\n") == 1
