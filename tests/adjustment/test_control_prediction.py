"""Control predicted from all other observations, against adjustments without it."""

import dataclasses
import json

import numpy as np
import pytest

import jaxbundle
from jaxbundle.leastsquares import problem as engine
from jaxbundle.leastsquares.quality.error_effects import first_rows
from jaxbundle.leastsquares.solution import Solution, find_minimum
from jaxbundle.report.page import compose

SIGMA = 0.004
CONTROL = 5


@pytest.fixture(scope="module")
def network():
    """Six photographs of twelve points, five of them control; one of these has one ray."""
    camera = jaxbundle.Camera(
        "cam", "brown", {"c": 20.0}, ("c", "x0", "y0"), image_size=(4000, 3000),
        pixel_size=(0.005, 0.005),
    )  # fmt: skip
    stations = jaxbundle.ring_of_stations(6, radius=10.0, height=6.0, roll_every=2)
    targets = jaxbundle.cloud_of_targets(12, (6.0, 6.0, 2.0), seed=3)
    made = jaxbundle.simulate(stations, targets, camera, noise=0.001, seed=1)
    points, rng = made.points, np.random.default_rng(2)
    role = np.array(points.role, dtype=object)
    role[:CONTROL] = "control"
    sigma = np.full((len(points), 3), np.nan)
    sigma[:CONTROL] = SIGMA
    position = np.array(targets, float)
    position[:CONTROL] += SIGMA * rng.normal(size=(CONTROL, 3))
    points = dataclasses.replace(points, role=tuple(role), sigma=sigma, position=position)
    rays = made.observations
    single = (rays.point == 4) & (np.cumsum(rays.point == 4) > 1)
    return made.replace(points=points, observations=rays.take(~single), datum="control")


def without(result, name, row):
    """The solution of a problem without a row of a set of observations."""
    problem = result.problem
    weight = dict(problem.data.weight)
    weight[name] = np.asarray(weight[name]) * (np.arange(len(weight[name])) != row)[:, None]
    changed = engine.with_data(problem, dataclasses.replace(problem.data, weight=weight))
    return Solution(changed, find_minimum(changed, result.values).values)


def test_control_is_predicted_as_an_adjustment_without_it_would(network):
    result = jaxbundle.adjust(network)
    found, given = result.control_prediction, network.points.position
    assert found.id == tuple(network.points.id[:CONTROL])
    for k in range(CONTROL - 1):
        alone = without(result, "control", k)
        X = np.asarray(alone.values["point"])[k] + result.problem.origin
        sigma = result.sigma0 * np.sqrt(np.diag(alone.cofactor("point")[k]) + SIGMA**2)
        np.testing.assert_allclose(found.sigma[k], sigma, rtol=2e-3)
        np.testing.assert_allclose(found.error[k] / sigma, (X - given[k]) / sigma, atol=0.01)
    # one ray leaves its point open along it
    assert np.isnan(found.error[CONTROL - 1]).all() and np.isnan(found.probability[CONTROL - 1])


def test_an_image_measurement_is_predicted_as_an_adjustment_without_it_would(network):
    result = jaxbundle.adjust(network)
    found = result.control_prediction
    problem, of = result.problem, dict(zip(found.measurement, found.image_error))
    sigma = dict(zip(found.measurement, found.image_sigma))
    rays = np.flatnonzero(problem.point < CONTROL)
    assert len(rays) == len(found.measurement)
    for row in rays[::4].tolist():
        alone = without(result, "image", row)
        name = network.images.id[problem.image[row]], network.points.id[problem.point[row]]
        # residuals of a row without weight are 0: those of its computed place
        shifted = dataclasses.replace(problem.data, start=alone.values)
        v = Solution(engine.with_data(problem, shifted), alone.values).residuals["image"][row]
        unit = 1 / problem.image_weights[row]
        np.testing.assert_allclose(of[name] / sigma[name], v * unit / sigma[name], atol=0.01)
        assert (sigma[name] > result.sigma0 * unit).all()


def test_a_wrong_point_and_a_wrong_measurement_are_named(network):
    """In the verdict, report, page and JSON."""
    points, rays = network.points, network.observations
    position, xy = points.position.copy(), rays.xy.copy()
    position[1, 2] += 25 * SIGMA
    row = int(np.flatnonzero((rays.point == 2) & (rays.image == 3))[0])
    xy[row, 0] += 0.03
    wrong = network.replace(
        points=dataclasses.replace(points, position=position),
        observations=dataclasses.replace(rays, xy=xy),
    )
    found = jaxbundle.adjust(wrong)
    point, ray = points.id[1], (network.images.id[3], points.id[2])
    at = found.control_prediction
    order = np.argsort(np.nan_to_num(at.probability, nan=1.0))
    assert at.id[order[0]] == point
    assert at.measurement[int(np.nanargmin(at.image_probability))] == ray
    (said,) = (one for one in found.verdict.findings if one.about == "Control")
    assert said.state == "not met" and f"{ray[1]} in {ray[0]}" in said.words
    assert at.error[1, 2] / at.sigma[1, 2] < -3  # predicted − given
    told = found.to_dict()
    json.dumps(told, allow_nan=False)
    assert told["control_prediction"]["points"][point]["Z"]["error"] == at.error[1, 2]
    shown = told["control_prediction"]["measurements"]
    (entry,) = (m for m in shown if (m["image"], m["point"]) == ray)
    assert abs(entry["x"]["error"]) > 0.02
    title = "Control predicted from all other observations"
    assert title in found.report() and title in "".join(compose(found))


def test_control_keeps_its_sigma_under_errors_of_image_points(network, tmp_path):
    """Errors along tracks and independent ones share the variance of image points; control has σ0
    times its own, whatever they are."""
    result = jaxbundle.adjust(network, correlated=True)
    model, found = result.error_model, result.cofactors.solution
    start = first_rows(found)["control"]
    D = np.zeros((3 * CONTROL, sum(v.size for v in found.residuals.values())))
    D[:, start : start + 3 * CONTROL] = np.eye(3 * CONTROL)
    np.testing.assert_allclose(
        model.of_effects(D), result.sigma0**2 * np.eye(3 * CONTROL), atol=1e-12
    )
    assert [size.name for size in model.sizes] == ["independent errors", "along tracks"]
    # the blocks of unknowns are those of the same Σ
    rows = {"point": np.zeros((3, len(network.points), 3))}
    rows["point"][:, 0] = np.eye(3)
    np.testing.assert_allclose(model.propagate_rows(rows), model.covariance("point")[0], rtol=0.3)
    result.save(tmp_path / "a.npz")
    again = jaxbundle.load_adjustment(tmp_path / "a.npz")
    np.testing.assert_allclose(again.error_model.of_effects(D), model.of_effects(D), rtol=1e-12)


def test_good_control_is_not_called_wrong(network):
    said = [one for one in jaxbundle.adjust(network).verdict.findings if one.about == "Control"]
    assert "contradicted" not in said[0].words


def test_predictions_under_an_error_model(network):
    """With independent errors of σ0 alone they are the classical ones; by a component of errors of
    one measurement, (1 − H)⁻¹·M·Σ·M·(1 − H)⁻¹."""
    result = jaxbundle.adjust(network, correlated=True)
    model, classical = result.error_model, jaxbundle.adjust(network).control_prediction
    theta = np.zeros(len(model.theta))
    theta[0] = result.sigma0**2
    result.keep(dataclasses.replace(model, theta=theta), None)
    found = result.control_prediction
    np.testing.assert_allclose(found.error, classical.error, rtol=1e-9)
    np.testing.assert_allclose(found.sigma, classical.sigma, rtol=1e-6)
    np.testing.assert_allclose(found.image_sigma, classical.image_sigma, rtol=1e-6)
    larger = jaxbundle.adjust(network, correlated=True)
    theta = theta.copy()
    theta[1:] = 4 * result.sigma0**2 * (np.arange(1, len(theta)) == 1)
    larger.keep(dataclasses.replace(model, theta=theta), None)
    grown = larger.control_prediction.image_sigma / classical.image_sigma
    assert np.nanmin(grown) > 1
