"""Refinement: injected errors are recovered, σ is correct, blunders are found, weakness is
named."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from refinement_scenes import (
    ARCSEC,
    COUNT,
    FREEDOM,
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
from jaxbundle.network.tables import Observations
from jaxbundle.pushbroom.corrections import Corrections
from jaxbundle.pushbroom.ground_to_image import misclosure
from jaxbundle.refinement import FREE, Freedom, refine, report, to_json
from jaxbundle.refinement.freedom import make_form, pad_forms
from jaxbundle.refinement.kinds import ScannerPoint, lines_of

BIAS, DRIFT = np.array([20.0, -30.0, 90.0]) * ARCSEC, np.array([5.0, -4.0, 30.0]) * ARCSEC
AMPLITUDE = np.array([8.0, 5.0, 0.0]) * ARCSEC


CHECK = range(COUNT, 2 * COUNT)
"""As many check points as control points."""


@pytest.fixture(scope="module")
def with_jitter():
    """Points, as they are and measured, of an image with bias, drift and a jitter of 1 Hz."""
    X, measurements = [], []
    for seed in (5, 8):
        rng = np.random.default_rng(seed)
        places, heights = spread(rng)
        X.append(ground_with_sine(satellite(), BIAS, DRIFT, AMPLITUDE, heights, places))
        measurements.append(measured(places, rng))
    n = 2 * COUNT
    xy, sigma = (np.concatenate([getattr(m, f) for m in measurements]) for f in ("xy", "sigma"))
    return np.concatenate(X), Observations(np.zeros(n, int), np.arange(n), xy, sigma)


@pytest.fixture(scope="module")
def refined(with_jitter):
    X, observations = with_jitter
    return refine([scanner()], control(X, CHECK), observations)


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
    truth = true_unknowns(refined.inspection.declared.inputs.forms[0])
    error = np.abs(refined.estimate - truth)
    assert len(truth) == 6 + 2 * refined.inspection.declared.inputs.forms[0].spline.unknowns
    assert (error < 3 * np.maximum(refined.inspection.sigma, 0)).all()
    # the biases are determined far better than they were wrong
    assert (refined.inspection.sigma[:2] < 0.1 * np.abs(BIAS[:2])).all()
    assert 0.75 < refined.sigma0 < 1.25


def test_blunders_are_found_and_nothing_else(with_jitter):
    X, observations = with_jitter
    xy = observations.xy.copy()
    wrong = {4: (0, 6.0), 17: (1, -5.0), 30: (0, -8.0)}
    for row, (axis, size) in wrong.items():
        xy[row, axis] += size
    spoilt = dataclasses.replace(observations, xy=xy)
    found = refine([scanner()], control(X, CHECK), spoilt, snooping="pope")
    removed = {f"P{k}" for k in wrong}
    assert {r["point"] for r in found.image_points() if r["removed"]} == removed
    assert 0.7 < found.sigma0 < 1.3
    text = report(found)
    assert all(f"point {id} in image A" in text for id in removed)
    assert len(to_json(found)["removed"]) == 3


@pytest.mark.further
def test_the_refined_image_sees_the_points_where_they_are(with_jitter, refined):
    """The image as written, slerp and all, against the adjusted residuals."""
    X, observations = with_jitter
    image = refined.image("A")
    v = np.array([row["v"] for row in refined.image_points()])
    g = np.array([
        misclosure(image, x, image.times.time(line), pixel, WGS84)
        for x, (line, pixel) in zip(X[:6], observations.xy[:6])
    ])
    scale = refined.inspection.solution.problem.data.measured["scanner points 1"].scale[:6]
    assert np.allclose(np.einsum("nij,nj->ni", scale, g), v[:6], atol=2e-3)


@pytest.mark.further
def test_the_residual_of_what_is_located_is_zero():
    switch = Corrections(True, True, True)
    image = satellite(switch)
    form, = pad_forms([make_form(image, WGS84, FREEDOM)])
    p = 1e-4 * np.random.default_rng(3).normal(size=sum(form.sizes))
    places, heights = np.array([[120.3, 600.2]]), np.array([350.0])
    X = ground(image, form, p, heights, places)
    kind, origin = ScannerPoint(switch, WGS84, form.sizes), np.zeros(3)
    line, _ = lines_of(kind, image, form, origin, *np.split(p, [form.image_unknowns]), X, places)
    line = jax.tree.map(lambda x: jnp.asarray(x[0]), line)
    g = kind.misclosure(*np.split(p, [form.image_unknowns]), X[0], line)
    # a pixel is 4e-5
    assert np.abs(g).max() < 1e-9


def test_check_points_and_their_sigma(refined):
    """In one image: their σ holds east and north."""
    found = refined.check
    assert found.id == tuple(f"P{k}" for k in CHECK)
    assert np.isnan(found.difference[:, 2]).all()
    for normed in (
        found.difference[:, :2] / found.sigma[:, :2], found.residual / found.residual_sigma
    ):  # fmt: skip
        assert 0.7 < np.sqrt(np.mean(normed**2)) < 1.3
    assert "Check points" in report(refined)
    assert len(to_json(refined)["check_points"]) == COUNT


@pytest.mark.further
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


@pytest.mark.further
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
