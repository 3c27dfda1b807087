"""Errors that image points share, in simulated networks: their sizes, and the σ under them."""

import dataclasses
import json

import numpy as np
import pytest

import jaxbundle
from jaxbundle.adjustment.quality.correlated_errors import splines, wendland
from jaxbundle.planning import grid_of_targets, ring_of_stations

IMAGES, SIGMA = 12, 0.2
CAMERA = jaxbundle.Camera(
    "cam", "opencv", {"fx": 1500.0, "fy": 1500.0, "cx": 999.5, "cy": 749.5, "k1": -0.05},
    free=("fx", "fy", "cx", "cy", "k1", "k2"), image_size=(2000, 1500),
)  # fmt: skip


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
        names, C = result.camera_covariance("cam")
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
    assert sizes["field on the sensor"].score > 4
    assert abs(sizes["field on the sensor"].size / 0.3 - 1) < 0.4
    told = result.to_dict()
    json.dumps(told, allow_nan=False)
    assert {c["name"] for c in told["error_components"]} == set(sizes)
    f = told["cameras"]["cam"]["parameters"]["fx"]
    assert f["sigma_correlated"] >= 0.9 * f["sigma"]
    assert "sigma_correlated" in told["images"][clean.images.id[0]]["X0"]
    assert "Correlated errors" in result.report()
    assert len(result.to_pandas("cameras")["sigma_correlated"])


def test_halves_show_what_classical_sigma_lack(clean):
    plain = jaxbundle.replicate(clean, by="photographs", repeat=3)
    assert 0.2 < plain.ratio < 2.2 and abs(plain.ratio_correlated / plain.ratio - 1) < 0.3
    shaken = jaxbundle.replicate(
        jaxbundle.adjust(disturbed(clean, 5, affine=0.4)), by="photographs", repeat=3
    )
    assert shaken.ratio > 4 and 0.3 < shaken.ratio_correlated < 2.2
    assert len(shaken.table()["parameter"]) == 3 * len(CAMERA.free)
    by_points = jaxbundle.replicate(clean, by="points")
    assert by_points.dof == len(CAMERA.free)


def test_what_cannot_be_replicated_is_said(clean):
    with pytest.raises(jaxbundle.InputError, match="did you mean 'photographs'|photographs"):
        jaxbundle.replicate(clean, by="photograph")
    held = clean.replace(cameras=(dataclasses.replace(CAMERA, free=()),))
    with pytest.raises(jaxbundle.InputError, match="no camera has a free parameter"):
        jaxbundle.replicate(held)


def test_splines_are_a_partition_of_one_and_kernels_are_positive():
    rng = np.random.default_rng(0)
    at = rng.uniform(-1, 1, (200, 2)) * [1, 0.7]
    B = splines(at, np.array([1, 0.7]), (11, 9))
    np.testing.assert_allclose(B.sum(1), 1, atol=1e-12)
    X = rng.normal(size=(40, 3))
    K = wendland(np.linalg.norm(X[:, None] - X, axis=2))
    assert np.linalg.eigvalsh(K).min() > 0 and wendland(np.array([0.0, 1.0, 2.0])).sum() == 1
