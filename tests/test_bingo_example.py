"""The indoor calibration of a video camera, re-simulated: the precision BINGO 5.5 printed."""

from pathlib import Path

import jax
import numpy as np
import pytest

import jaxbundle
from jaxbundle.geometry import matrix_from_quaternion, phi_omega_kappa_from_matrix

PROJECT = Path(__file__).parents[1] / "examples" / "bingo_indoor" / "project.toml"
NAMES = ("p25", "p26", "c", "x0", "y0")


@pytest.fixture(scope="module")
def result():
    adjusted = jaxbundle.adjust(jaxbundle.read_network(PROJECT))
    assert adjusted.converged
    assert adjusted.warnings == ()
    return adjusted


def test_counts_and_sigma0(result):
    assert result.redundancy == 1893
    assert result.counts.observations == 2 * 1156
    assert result.counts.pseudo_observations == 12 + 3
    # the noise was drawn with the listed σ0; √(2·1893) is the relative precision of an estimate
    assert 30 * result.sigma0 == pytest.approx(27.16, rel=4 / np.sqrt(2 * 1893))


def test_listed_standard_deviations(result):
    parameters = result.cameras["cam1"]["parameters"]
    sigma = [1000 * parameters[name]["sigma"] for name in NAMES]
    np.testing.assert_allclose(sigma, [28.3, 54.0, 60.1, 14.5, 17.3], rtol=0.03)
    total = [parameters[name]["total_correlation"] for name in NAMES]
    np.testing.assert_allclose(total, [0.56, 0.18, 0.62, 0.04, 0.20], atol=0.02)


@pytest.mark.parametrize(
    "a, b, listed",
    [("p26", "p25", -13), ("c", "p25", -69), ("c", "p26", -18), ("y0", "c", 43),
     ("y0", "p25", -26), ("x0", "p25", 17), ("x0", "p26", 2), ("x0", "c", -17),
     ("y0", "p26", 0), ("y0", "x0", -5)],
)  # fmt: skip
def test_listed_correlations(result, a, b, listed):
    camera = result.cameras["cam1"]
    i, j = camera["free"].index(a), camera["free"].index(b)
    assert 100 * camera["correlations"][i, j] == pytest.approx(listed, abs=2.6)


def test_parameters_agree_with_the_listing(result):
    parameters = result.cameras["cam1"]["parameters"]
    listed = dict(zip(NAMES, (16.3057, -1.7983, 126.9924, -0.0049, 0.1569)))
    for name, value in listed.items():
        assert abs(parameters[name]["value"] - value) < 4 * parameters[name]["sigma"], name


def test_listed_redundancy_of_each_group(result):
    found = {name: c.redundancy for name, c in result.variance_components.items()}
    assert found["image coordinates"] == pytest.approx(1889.75, abs=0.02)
    assert found["interior orientation"] == pytest.approx(2.50, abs=0.01)
    assert sum(r for name, r in found.items() if "control" in name) == pytest.approx(0.75, abs=0.01)


def test_listed_redundancy_numbers_of_the_control(result):
    rows = result.residuals
    control = rows["kind"] == "control"
    r = {
        (point, axis): 100 * value
        for point, axis, value in zip(
            rows["point"][control], rows["axis"][control], rows["r"][control]
        )
    }
    listed = {"100": (7, 5, 3), "111": (9, 7, 3), "1200": (6, 10, 3), "1211": (10, 9, 3)}
    for point, values in listed.items():
        found = [r[point, axis] for axis in "XYZ"]
        np.testing.assert_allclose(found, values, atol=0.6, err_msg=point)


def test_listed_precision_of_the_angles(result):
    """φ, ω, κ of the photographs; BINGO's own sequence, M = R3(κ)·R1(ω)·R2(φ)."""

    def angles(values):
        matrices = jax.vmap(matrix_from_quaternion)(values["image"].rotation)
        return jax.vmap(phi_omega_kappa_from_matrix)(matrices).ravel()

    variance = np.diagonal(result.covariance_of(angles)).reshape(-1, 3)
    rms = np.sqrt(variance.mean(0)) * 200 / np.pi * 1000
    np.testing.assert_allclose(rms, [42.0, 45.9, 17.6], rtol=0.01)
