"""Blunders in a network: data snooping by removal and return, robust estimation by weights."""

import dataclasses
import json
import re

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import integrate

import jaxbundle
from jaxbundle import Camera, InputError, NotSolvedError
from jaxbundle.adjustment import far_points
from jaxbundle.adjustment.adjust import adjust, snoop_again
from jaxbundle.adjustment.quality.inspection import Inspection
from jaxbundle.cameras import get_model, residual
from jaxbundle.choices import ESTIMATORS
from jaxbundle.geometry import matrix_from_quaternion
from jaxbundle.io import adjusted_network
from jaxbundle.io.results.result_json import result_dict, result_text
from jaxbundle.leastsquares.quality import robust, snooping
from jaxbundle.leastsquares.quality.robust import residual_lengths, robust_scale
from jaxbundle.leastsquares.quality.snooping import (
    RemovedRow,
    _passing,
    _TouchedRows,
    _worst,
    without,
)
from jaxbundle.leastsquares.solution import Solution, find_minimum
from jaxbundle.network import Distances
from jaxbundle.report import text

SIGMA = 0.002
TRUE = {"c": 24.0, "x0": 0.05, "y0": -0.03, "K1": 1.2e-4}


@pytest.fixture(scope="module")
def network():
    """Ten convergent images around a box of 125 points, free, self-calibrating."""
    stations = jaxbundle.ring_of_stations(10, 6.0, 3.0, look_at=(0.0, 0.0, 0.5), roll_every=2)
    axis = np.linspace(-1, 1, 5)
    targets = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), -1).reshape(-1, 3)
    camera = Camera("cam", "brown", TRUE, free=("c", "x0", "y0", "K1", "P1", "P2"))
    return jaxbundle.simulate(stations, targets, camera, noise=SIGMA, seed=11, disturb=0.01)


@pytest.fixture(scope="module")
def clean(network):
    return adjust(network)


def with_blunders(network, seed, part=0.05):
    """Errors of 5 to 50 σ in any direction; which rows have one, and their sizes in σ."""
    rng = np.random.default_rng(seed)
    rays = network.observations
    bad = rng.random(len(rays)) < part
    size, angle = rng.uniform(5, 50, len(rays)), rng.uniform(0, 2 * np.pi, len(rays))
    shift = (bad * size * SIGMA)[:, None] * np.stack([np.cos(angle), np.sin(angle)], 1)
    return network.replace(
        observations=dataclasses.replace(rays, xy=rays.xy + shift)
    ), bad, size


def rows_of(removed, network):
    rays = network.observations
    names = [
        f"point {network.points.id[p]} in image {network.images.id[i]}"
        for i, p in zip(rays.image, rays.point)
    ]
    return np.isin(names, [r.name for r in removed])


def differences(found, clean):
    """Parameters of the camera against those of the clean data, in σ of `found`."""
    return [
        abs(entry["value"] - clean.cameras["cam"]["parameters"][name]["value"]) / entry["sigma"]
        for name, entry in found.cameras["cam"]["parameters"].items() if entry["free"]
    ]  # fmt: skip


@pytest.mark.further
def test_snooping_of_many_blunders(network, clean):
    spoilt, bad, size = with_blunders(network, 1)
    found = adjust(spoilt, snooping="pope")
    gone = rows_of(found.removed, spoilt)
    number = clean.residuals["r"].reshape(-1, 2).min(1)
    clear = bad & (size > 8) & (number > 0.3)
    assert clear.sum() > 30
    assert gone[clear].mean() >= 0.95
    assert gone[~bad].mean() <= 0.01
    assert abs(found.sigma0 - 1) < 0.1
    assert max(differences(found, clean)) < 1.5


@pytest.mark.further
def test_baarda_finds_them_too(network):
    spoilt, bad, size = with_blunders(network, 2, 0.01)
    found = adjust(spoilt, snooping="baarda", significance=1e-5)
    gone = rows_of(found.removed, spoilt)
    assert gone[bad & (size > 8)].all() and gone[~bad].sum() <= 1


def test_what_agrees_comes_back(network):
    """Removed observations that agree with an adjustment without them are restored."""
    spoilt, bad, _ = with_blunders(network, 1)
    whole = jaxbundle.make_problem(jaxbundle.check_network(spoilt))
    wrong, right = np.flatnonzero(bad), np.flatnonzero(~bad)[::97]
    removed = [RemovedRow("image", int(row), None, 9.0) for row in (*wrong, *right)]
    less = without(whole, removed)
    found = Solution(less, find_minimum(less, max_steps=101).values)
    back = {row for _, row, _ in _passing(whole, found, _TouchedRows(whole), removed, 4.5)}
    assert back >= set(right)
    assert len(back & set(wrong)) <= 0.05 * len(wrong)


def test_what_nothing_is_left_to_test_has_no_test(network):
    """Rays that were suspected from the beginning: a good one among bad ones comes back, a bad one
    keeps the test that removes it, all of a point stay out, untested."""
    rays, ids = network.observations, (network.images.id, network.points.id)
    of_point = np.flatnonzero(rays.point == 62)
    good, bad = np.flatnonzero(rays.point == 30)[0], np.flatnonzero(rays.point == 31)[0]
    xy = rays.xy.copy()
    xy[bad] += 40 * SIGMA
    spoilt = network.replace(observations=dataclasses.replace(rays, xy=xy))
    suspects = [(ids[0][rays.image[k]], ids[1][rays.point[k]]) for k in (*of_point, good, bad)]
    found = adjust(spoilt, snooping="pope", doubtful=suspects)
    removed = rows_of(found.removed, network)
    assert removed[of_point].all() and removed[bad] and not removed[good]
    test = {r.name: r.test for r in found.removed}
    untested = [name for name, value in test.items() if np.isnan(value)]
    assert len(untested) == len(of_point) and all("point " + ids[1][62] in n for n in untested)
    (of_bad,) = (value for name, value in test.items() if "point " + ids[1][31] + " " in name)
    # 40 σ in both coordinates, √(1 + h) at most √2 as uncertain as predicted.
    assert 20 < of_bad < 41 * np.sqrt(2) and found.sigma0 < 1.1
    assert "not tested again" in " ".join(found.report().split())
    told = [entry["test"] for entry in found.to_dict()["removed"]]
    assert told.count(None) == len(of_point)


def test_snooping_from_an_earlier_result_ends_at_the_same(network):
    """With other σ, from an adjustment with all blunders: as a whole adjustment."""
    spoilt, bad, _ = with_blunders(network, 2, 0.01)
    earlier, rays = adjust(spoilt), spoilt.observations
    suspects = [
        (spoilt.images.id[i], spoilt.points.id[p])
        for i, p in zip(rays.image[bad][::2], rays.point[bad][::2])
    ]
    larger = lambda n: n.replace(
        observations=dataclasses.replace(n.observations, sigma=1.3 * n.observations.sigma)
    )
    expected = adjust(larger(spoilt), snooping="pope", doubtful=suspects)
    weighted = larger(earlier.problem.network)
    found = snoop_again(earlier, weighted, earlier.values, suspects, 0.001, 100)
    assert found.converged and found.redundancy == expected.redundancy
    assert {r.name for r in found.removed} == {r.name for r in expected.removed}
    assert len(found.removed) > len(suspects)
    assert found.sigma0 == pytest.approx(expected.sigma0, rel=1e-9)
    np.testing.assert_allclose(found.image_values, expected.image_values, atol=1e-7)
    np.testing.assert_allclose(found.image_covariance, expected.image_covariance, rtol=1e-5)


def test_predicted_test_of_an_observation(network):
    """v/√(1 + h) against the residual and its covariance, both from the formula of the camera."""
    problem = jaxbundle.make_problem(jaxbundle.check_network(network))
    row, data = 123, problem.data
    less = without(problem, [RemovedRow("image", row, None, 0.0)])
    minimum = find_minimum(less, data.start, max_steps=101)
    found = Inspection(less, minimum.values).solution
    predicted = found.predicted_tests(problem.data)["image"][row]
    i, p = problem.image[row], problem.point[row]
    model = get_model("brown")

    def misclosure(v):
        position, rotation = v["image"]
        ray = matrix_from_quaternion(rotation[i]) @ (v["point"][p] - position[i])
        xy = data.measured["image"][row]
        return jnp.stack(residual(model, "corrected", tuple(v["camera"][0]), ray, xy))

    result = jaxbundle.Adjustment(less.network, less, minimum)
    h = np.diagonal(result.covariance_of(misclosure)) / result.sigma0**2 / SIGMA**2
    expected = np.asarray(misclosure(result.values)) / SIGMA / np.sqrt(1 + h)
    np.testing.assert_allclose(predicted, expected, rtol=1e-5)


@pytest.mark.parametrize("estimator", ESTIMATORS)
def test_robust_estimates_are_near_the_clean_one(network, clean, estimator):
    spoilt, bad, size = with_blunders(network, 3)
    found = adjust(spoilt, robust=estimator)
    assert max(differences(found, clean)) < 1
    assert found.weights[bad & (size > 20)].max() < 0.25
    assert np.median(found.weights[~bad]) > 0.8
    assert "Robust estimation" in text(found)
    assert found.residuals["weight"][:2] == pytest.approx(found.weights[0], abs=0)


def test_without_blunders_huber_is_least_squares(network, clean):
    """One good image point in ninety is touched: the estimates agree to a small part of σ."""
    assert max(differences(adjust(network, robust="huber"), clean)) < 0.3


def test_huber_minimises_his_function(network):
    """At the solution Σ ρ(t), ρ = t²/2 or k·t − k²/2, is stationary along camera parameters."""
    spoilt, _, _ = with_blunders(network, 3)
    found = adjust(spoilt, robust="huber")
    problem = jaxbundle.make_problem(jaxbundle.check_network(spoilt))
    lengths = residual_lengths(Inspection(problem, found.values).solution)
    scale = robust_scale(problem, lengths)

    def total(step):
        moved = found.values["camera"].at[0, 0].add(step)
        values = eqx.tree_at(lambda v: v["camera"], found.values, moved)
        t = Inspection(problem, values).lengths / scale
        return np.where(t < 3, t**2 / 2, 3 * t - 4.5).sum()

    step = 0.3 * found.cameras["cam"]["parameters"]["c"]["sigma"]
    slope = (total(step) - total(-step)) / 2
    curvature = total(step) - 2 * total(0.0) + total(-step)
    assert abs(slope) < 0.02 * curvature


def test_huber_touches_one_good_image_point_in_ninety():
    """P(t > k) = exp(−k²/2) for t² ~ χ²₂."""
    length = lambda number: np.sqrt(2 * np.log(number))  # exceeded by one in this many
    rarer, more_often = robust.huber(np.array([length(91.0), length(89.0)]))
    assert rarer < 1 == more_often


@pytest.mark.parametrize(("weight", "k"), [(robust.cauchy, 2.5486), (robust.tukey, 5.1230)])
def test_efficiency_in_the_plane_is_95_percent(weight, k):
    """E[ψ' + ψ/t]²/(2·E[ψ²]) for t² ~ χ²₂, by numerical integration (Maronna, 1976), of the weights
    as they are used; k: where ψ is not smooth."""
    efficiency = 0.95
    density = lambda t: t * np.exp(-t * t / 2)
    psi = lambda t: t * float(weight(np.array(t)))
    slope = lambda t: (psi(t + 1e-5) - psi(t - 1e-5)) / 2e-5
    mean = lambda f: integrate.quad(lambda t: f(t) * density(t), 1e-4, 12, points=[k], limit=200)[0]
    found = mean(lambda t: slope(t) + psi(t) / t) ** 2 / (2 * mean(lambda t: psi(t) ** 2))
    assert found == pytest.approx(efficiency, abs=1e-3)


# --- what cannot be told apart, large networks, wrong σ ---------------------------------------


def test_either_of_two_rays(network):
    """A point with two rays that contradict each other: either may be wrong, both are removed."""
    rays = network.observations
    keep = rays.point != 62
    pair = np.flatnonzero(~keep)[[0, 3]]
    keep[pair] = True
    xy = rays.xy.copy()
    xy[pair[0], 1] += 30 * SIGMA
    spoilt = network.replace(observations=dataclasses.replace(rays, xy=xy).take(keep))
    found = adjust(spoilt, snooping="pope")
    (removed,) = found.removed
    point, images = network.points.id[62], [network.images.id[i] for i in rays.image[pair]]
    assert removed.name.startswith("either of ") and len(removed.rows) == 2
    assert all(f"point {point} in image {image}" in removed.name for image in images)
    assert not (found.problem.image_weights[list(removed.rows)] > 0).any()
    assert "either of" in text(found) and "does not show which" in text(found)
    assert f"do not determine them: {point}." in " ".join(text(found).split())
    assert np.isnan([found.points[name][62] for name in ("X", "sX", "rms")]).all()
    written = json.loads("".join(result_text(found)))["points"][point]
    assert written["X"] == {"value": None, "sigma": None}
    assert point not in adjusted_network(found).points.id
    with pytest.raises(InputError, match="excluded by data snooping"):
        found.covariance(("point", point, "Z"))
    with pytest.raises(InputError, match="excluded by data snooping"):
        jaxbundle.sensitivity(found, {("point", point, "Z"): 0.1})
    assert result_dict(found, brief=True)["removed"][0]["name"] == removed.name


@pytest.mark.further
@pytest.mark.parametrize("role", ["control", "tie"])
def test_points_without_good_rays_and_other_observations(network, role):
    """A height alone does not locate a point without rays; a distance to it keeps it."""
    rays, points = network.observations, network.points
    pair = np.flatnonzero(rays.point == 62)[[0, 3]]
    xy = rays.xy.copy()
    xy[pair[0], 1] += 30 * SIGMA
    kept = (rays.point != 62) | np.isin(np.arange(len(rays)), pair)
    spoilt = network.replace(observations=dataclasses.replace(rays, xy=xy).take(kept))
    if role == "control":
        sigma, roles = points.sigma.copy(), list(points.role)
        sigma[[0, 4, 20]], sigma[62] = 0.01, [np.inf, np.inf, 0.01]
        for k in (0, 4, 20, 62):
            roles[k] = "control"
        spoilt = spoilt.replace(points=dataclasses.replace(points, sigma=sigma, role=tuple(roles)))
        found = adjust(spoilt, snooping="pope")
        assert found.converged and np.isnan(found.point_values[62]).all()
    else:
        X = points.position
        ends = np.array([[62, 0]])
        length = np.linalg.norm(X[62] - X[0], keepdims=True)
        spoilt = spoilt.replace(distances=Distances(ends, length, np.array([0.01])))
        with pytest.raises(NotSolvedError, match="no longer determined"):
            adjust(spoilt, snooping="pope")


def test_rays_that_cannot_mask_each_other_go_together(network):
    """More than one of an image at a time, but one of a point; and they are the blunders."""
    spoilt, bad, _ = with_blunders(network, 1)
    problem = jaxbundle.make_problem(jaxbundle.check_network(spoilt))
    found = Solution(problem, find_minimum(problem, max_steps=101).values)
    worst = _worst(found, _TouchedRows(problem), found.sigma0, 4.5, 3.29)
    rows = np.array([r.row for r in worst])
    image, point = problem.image[rows], problem.point[rows]
    assert np.bincount(image).max() > 1 and len(set(point)) == len(rows)
    assert bad[rows].all()


@pytest.mark.parametrize("options", [
    {"snooping": "pope"}, pytest.param({"robust": "tukey"}, marks=pytest.mark.further),
])  # fmt: skip
def test_a_large_network_takes_single_steps(network, options, monkeypatch):
    """To the same end, with two whole adjustments after the first."""
    spoilt, _, _ = with_blunders(network, 1)
    usual = adjust(spoilt, **options)
    monkeypatch.setattr(snooping, "SINGLE_STEPS_FROM", 0)
    calls, whole = [], far_points.find_minimum
    counted = lambda *a, **k: calls.append(1) or whole(*a, **k)
    monkeypatch.setattr(far_points, "find_minimum", counted)
    found = adjust(spoilt, **options)
    assert len(calls) <= 3
    names = lambda result: {r.name for r in (*result.removed, *result.suspects)}
    assert names(found) == names(usual) and len(names(found)) > 30
    assert found.sigma0 == pytest.approx(usual.sigma0, rel=1e-3)
    assert max(differences(found, usual)) < 0.01


@pytest.fixture(scope="module")
def contradicted(network):
    """σ a priori too small by 1.49."""
    rays = network.observations
    return network.replace(observations=dataclasses.replace(rays, sigma=rays.sigma / 1.49))


@pytest.mark.further
def test_baardas_test_with_wrong_sigma_says_so(network):
    """The scale is that of all good points, not of those which fitted and so were left."""
    factor, significance = 3.0, 0.001
    rays = network.observations
    wrong = network.replace(observations=dataclasses.replace(rays, sigma=rays.sigma / factor))
    found = adjust(wrong, snooping="baarda", significance=significance)
    assert len(found.removed) > 0.2 * len(rays)
    doubt = found.doubts[0]
    scale = float(re.search(r"most residuals are ([\d.]+) times", doubt)[1])
    assert scale == pytest.approx(factor, rel=0.05) and "--snooping pope" in doubt
    assert f"significance {significance:g} removes" in doubt
    assert doubt in result_dict(found, brief=True)["warnings"]
    assert "Baarda's test trusts" in text(found)


@pytest.mark.parametrize("part, said", [(0.01, False), (0.2, True)])
def test_baardas_test_does_not_take_blunders_for_wrong_sigma(network, part, said):
    """A fifth of blunders makes the scale before their removal 3.8: the message is about too many
    removals, not about wrong σ."""
    spoilt, _, _ = with_blunders(network, 1, part)
    found = adjust(spoilt, snooping="baarda")
    assert any("Baarda's test has removed many" in doubt for doubt in found.doubts) == said
    assert not any("Baarda's test trusts" in doubt for doubt in found.doubts)


def test_popes_test_does_not_believe_the_sigma(contradicted, clean):
    (other,) = adjust(contradicted, snooping="pope").doubts
    assert other.startswith("χ² test clearly failed: vᵀPv/redundancy is 2.")
    assert clean.doubts == ()


def test_robust_estimation_does_not_believe_the_sigma(network, contradicted):
    """Weights of the a posteriori scale; the suspects are listed as removals are."""
    spoilt, bad, size = with_blunders(network, 3)
    rays = spoilt.observations
    wrong = spoilt.replace(observations=dataclasses.replace(rays, sigma=rays.sigma / 1.49))
    usual, found = adjust(spoilt, robust="tukey"), adjust(wrong, robust="tukey")
    np.testing.assert_allclose(found.weights, usual.weights, atol=0.01)
    assert found.robust_scale == pytest.approx(1.49 * usual.robust_scale, rel=1e-3)
    assert usual.robust_scale == pytest.approx(1, abs=0.1) and usual.doubts == ()
    assert "MAD" in found.doubts[0] and "MAD" in text(usual)
    suspected = rows_of(found.suspects, spoilt)
    assert suspected[bad & (size > 10)].all() and not suspected[~bad].any()
    brief = result_dict(found, brief=True)
    assert brief["robust_scale"] == found.robust_scale and found.doubts[0] in brief["warnings"]
    assert [s["name"] for s in brief["suspects"]] == [s.name for s in found.suspects]
    assert {"kind", "name", "test", "weight"} == set(brief["suspects"][0])


def test_what_cannot_be_asked_for(network):
    with pytest.raises(InputError, match="huber, cauchy, tukey"):
        adjust(network, robust="l1")
    with pytest.raises(InputError, match="not both"):
        adjust(network, robust="huber", snooping="pope")


@pytest.mark.parametrize("options, said", [
    ({"snooping": "x"}, "snooping must be one of pope, baarda or None, not 'x'"),
    ({"snooping": True}, "snooping must be one of pope, baarda or None, not True"),
    ({"snooping": "pope", "significance": 2.0}, "significance .*a number between 0 and 1"),
])  # fmt: skip
def test_a_test_that_is_none_is_refused_at_once(network, options, said):
    """Before anything is computed."""
    with pytest.raises(InputError, match=said):
        adjust(network, **options)
    with pytest.raises(InputError, match=said):
        jaxbundle.calibrate(["nowhere.jpg"], jaxbundle.Board(9, 6, 0.03), **options)
