"""Refinement: what was injected comes back, σ is honest, blunders are found, weakness is named."""

import dataclasses

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from refinement_scenes import (
    ARCSEC,
    COUNT,
    FREEDOM,
    JITTER,
    SIGMA,
    control,
    ground,
    ground_with_sine,
    measured,
    satellite,
    scanner,
    spread,
)

from jaxbundle.errors import NotSolvedError
from jaxbundle.geometry.ellipsoid import WGS84
from jaxbundle.pushbroom.corrections import Corrections
from jaxbundle.refinement import FREE, Freedom, line_residual, refine, report, to_json
from jaxbundle.refinement.build import choose_rays, make_columns, make_system
from jaxbundle.refinement.freedom import make_form, names
from jaxbundle.refinement.inspection import count_redundancy
from jaxbundle.refinement.solver import normal, solve

pytestmark = pytest.mark.xdist_group("refinement")

BIAS, DRIFT = np.array([20.0, -30.0, 90.0]) * ARCSEC, np.array([5.0, -4.0, 30.0]) * ARCSEC
AMPLITUDE = np.array([8.0, 5.0, 0.0]) * ARCSEC


@pytest.fixture(scope="module")
def with_jitter():
    """Control points of an image with bias, drift and a jitter of 1 Hz."""
    rng = np.random.default_rng(5)
    places, heights = spread(rng)
    X = np.asarray(ground_with_sine(satellite(), BIAS, DRIFT, AMPLITUDE, heights, places))
    return X, measured(places, rng)


@pytest.fixture(scope="module")
def refined(with_jitter):
    X, observations = with_jitter
    return refine([scanner()], control(X), observations)


def true_unknowns(form):
    """The unknowns nearest to bias, drift and sine: the spline's line belongs to the former."""
    spline = form.spline
    t = np.linspace(0, 3, 400)
    x = np.abs((t[:, None] - spline.centres) / spline.spacing)
    B = np.where(x < 1, 2 / 3 - x**2 + x**3 / 2, np.maximum(2 - x, 0) ** 3 / 6)
    c = np.linalg.lstsq(B, np.sin(2 * np.pi * t), rcond=None)[0]
    assert np.abs(B @ c - np.sin(2 * np.pi * t)).max() < 0.03
    line = np.polyfit(spline.centres - 899 / 600, c, 1)
    z = spline.basis.T @ c
    bias, drift = BIAS + AMPLITUDE * line[1], DRIFT + AMPLITUDE * line[0]
    return np.concatenate([bias, drift, np.outer(AMPLITUDE[:2], z).ravel()])


def test_bias_drift_and_jitter_of_1_hz_come_back_within_3_sigma(refined):
    truth = true_unknowns(refined.columns.forms[0])
    error = np.abs(refined.estimate - truth)
    assert len(truth) == 6 + 2 * refined.columns.forms[0].spline.unknowns
    assert (error < 3 * np.maximum(refined.inspection.sigma, 0)).all()
    # the biases are determined far better than they were wrong
    assert (refined.inspection.sigma[:2] < 0.1 * np.abs(BIAS[:2])).all()
    assert 0.75 < refined.sigma0 < 1.25


def test_redundancy_numbers_sum_up_to_the_redundancy(refined):
    found = refined.inspection
    assert np.isclose(np.nansum(found.r), refined.redundancy, atol=1e-6)
    jitter = len(refined.columns.names) - 6
    assert refined.redundancy == 2 * COUNT + jitter - len(refined.columns.names)


def test_cofactors_and_tests_against_dense_numpy(refined):
    reduced, v = normal(refined.inspection.system, refined.inspection.unknowns)
    A, v = np.asarray(reduced.jacobian.shared), np.asarray(v)
    Q = np.linalg.inv(A.T @ A)
    assert np.allclose(refined.inspection.cofactor, Q, rtol=1e-6, atol=1e-9 * Q.max())
    used = np.isfinite(refined.inspection.w)
    r = 1 - np.einsum("ri,ij,rj->r", A, Q, A)
    assert np.allclose(refined.inspection.w[used], (v / np.sqrt(np.abs(r)))[used], rtol=1e-5)


def test_sigma_is_honest():
    """60 draws of jitter (from its prior), bias, drift and noise: errors as Q says."""
    rng = np.random.default_rng(11)
    one = scanner()
    form, columns = make_form(one.image, one.earth, FREEDOM), make_columns([one], None)
    places, heights = spread(rng)
    X = np.asarray(ground(one.image, form, np.zeros(len(columns.scanners[0])), heights, places))
    observations = measured(places, rng)
    points = control(X)
    rays, *_ = choose_rays(points, observations, None)
    system = make_system([one], points, observations, None, columns, rays)
    redundancy = jnp.asarray(float(count_redundancy(system)))
    m, draws = len(columns.names), 60
    squares, normed = [], []
    for _ in range(draws):
        truth = JITTER * rng.normal(size=m)
        X = ground(one.image, form, np.r_[truth, 0][columns.scanners[0]], heights, places)
        noisy = places + SIGMA * rng.normal(size=places.shape)
        drawn = eqx.tree_at(lambda s: (s.X, s.scanners[0].place), system, (X, jnp.asarray(noisy)))
        found = solve(drawn, drawn.start(), redundancy)
        assert bool(found.settled)
        error = np.asarray(found.unknowns.shared) - truth
        Q = np.asarray(normal(drawn, found.unknowns)[0].cofactor)
        squares.append(error @ np.linalg.solve(Q, error))
        normed.append(error / np.sqrt(np.diagonal(Q)))
    # the mean of χ² of m degrees of freedom: sampling error √(2/(m·draws)) of it
    assert abs(np.mean(squares) / m - 1) < 3 * np.sqrt(2 / (m * draws))
    rms = np.sqrt(np.mean(np.square(normed), 0))
    assert (np.abs(rms - 1) < 4 / np.sqrt(2 * draws)).all()


def test_blunders_are_found_and_nothing_else(with_jitter):
    X, observations = with_jitter
    xy = observations.xy.copy()
    wrong = {4: (0, 6.0), 17: (1, -5.0), 30: (0, -8.0)}
    for row, (axis, size) in wrong.items():
        xy[row, axis] += size
    spoilt = dataclasses.replace(observations, xy=xy)
    found = refine([scanner()], control(X), spoilt, snooping="pope")
    removed = {f"P{k}" for k in wrong}
    assert {r["point"] for r in found.image_points() if r["removed"]} == removed
    assert 0.7 < found.sigma0 < 1.3
    text = report(found)
    assert all(f"point {id} in image A" in text for id in removed)
    assert len(to_json(found)["removed"]) == 3


def test_the_refined_image_sees_the_points_where_they_are(with_jitter, refined):
    """The image as written, slerp and all, against the adjusted residuals."""
    X, observations = with_jitter
    image = refined.image("A")
    still = make_form(image, WGS84, Freedom())
    v = np.array([row["v"] for row in refined.image_points()])
    n = 3 * 4 + 4
    g = np.array([
        line_residual(image, WGS84, still, jnp.zeros(n), jnp.asarray(x), jnp.asarray(place))
        for x, place in zip(X[:6], observations.xy[:6])
    ])
    scale = np.asarray(refined.inspection.system.scanners[0].scale)[:6]
    assert np.allclose(np.einsum("nij,nj->ni", scale, g), v[:6], atol=2e-3)


@pytest.mark.parametrize("switch", [Corrections(), Corrections(True, True, True)])
def test_the_residual_of_what_is_located_is_zero(switch):
    image = satellite(switch)
    form = make_form(image, WGS84, FREEDOM)
    p = 1e-4 * np.random.default_rng(3).normal(size=len(names(form, "A", "A")))
    places, heights = np.array([[120.3, 600.2]]), np.array([350.0])
    X = ground(image, form, p, heights, places)
    g = eqx.filter_jit(line_residual)(image, WGS84, form, jnp.asarray(p), X[0], places[0])
    # a pixel is 4e-5
    assert np.abs(g).max() < (1e-9 if switch.any else 1e-13)


def test_check_points_and_their_sigma(with_jitter):
    """As many check points as control points, in one image: their σ holds east and north."""
    X, observations = with_jitter
    rng = np.random.default_rng(8)
    places, heights = spread(rng)
    others = ground_with_sine(satellite(), BIAS, DRIFT, AMPLITUDE, heights, places)
    both = measured(np.concatenate([observations.xy, places]), rng, sigma=0.0)
    both.xy[COUNT:] += SIGMA * rng.normal(size=places.shape)
    check = set(range(COUNT, 2 * COUNT))
    result = refine([scanner()], control(np.concatenate([X, others]), check), both)
    found = result.check
    assert found.id == tuple(f"P{k}" for k in sorted(check))
    assert np.isnan(found.difference[:, 2]).all()
    for normed in (
        found.difference[:, :2] / found.sigma[:, :2], found.residual / found.residual_sigma
    ):  # fmt: skip
        assert 0.7 < np.sqrt(np.mean(normed**2)) < 1.3
    assert "Check points" in report(result)
    assert len(to_json(result)["check_points"]) == COUNT


def test_what_flat_ground_does_not_determine_is_named():
    rng = np.random.default_rng(2)
    places, heights = spread(rng, relief=0.0)
    one = scanner(Freedom(attitude=FREE, position=(30.0, 30.0, 30.0), focal_length=1e-3))
    form = make_form(one.image, one.earth, one.freedom)
    X = np.asarray(ground(one.image, form, np.zeros(16), heights, places))
    found = refine([one], control(X), measured(places, rng))
    said = " | ".join(found.warnings)
    for pair in (
        ("pitch bias", "position along track"), ("roll bias", "position across track"),
        ("focal length", "position up"),
    ):  # fmt: skip
        assert any(all(word in warning for word in pair) for warning in found.warnings), said


def test_the_same_twice_is_refused_by_name():
    """Mounting and attitude bias of one image turn it alike."""
    rng = np.random.default_rng(2)
    places, heights = spread(rng)
    one = scanner(Freedom(attitude=FREE, mounting=FREE, focal_length=1e-3))
    form = make_form(one.image, one.earth, one.freedom)
    X = np.asarray(ground(one.image, form, np.zeros(16), heights, places))
    with pytest.raises(NotSolvedError, match="mounting .* and [23] more directions") as error:
        refine([one], control(X), measured(places, rng))
    said = " ".join(error.value.undetermined)
    assert "mounting pitch" in said and "pitch bias of image A" in said
    assert len(str(error.value)) < 300
