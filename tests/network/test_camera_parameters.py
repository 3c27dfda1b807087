"""Observed camera parameters and ratios of them: as priors, as ties, refused by name."""

import dataclasses

import numpy as np
import pytest
from further_checks import check_jacobians
from test_ties import network as ties_network

import jaxbundle
from jaxbundle.adjustment.quality.inspection import Inspection
from jaxbundle.errors import InputError
from jaxbundle.network.build import make_further


def observed(*rows):
    """Ten photographs of `test_ties`, fx and fy free, with these observed parameters."""
    network = ties_network(()).network
    if not rows:
        return network
    columns = dict(zip(("camera", "parameter", "value", "sigma"), map(list, zip(*rows))))
    return network.replace(further=make_further({"camera_parameters": columns}, 1.0))


def focal_lengths(result):
    return np.array([result.camera_parameters("cam")[name] for name in ("fx", "fy")])


def cofactors_of_focal_lengths(result, values):
    return Inspection(result.problem, values).propagate(lambda v: v["camera"][0, :2])


@pytest.fixture(scope="module")
def apart():
    return jaxbundle.adjust(observed())


def test_an_observed_parameter_is_a_prior_with_a_value_of_its_own(apart):
    """At the start value it is the prior σ of the camera; elsewhere the result follows it, not the
    start value: x̂ = x + q/(q + σ²)·(l − x), to first order."""
    start = observed().cameras[0].parameters["fx"]
    s = apart.cameras["cam"]["parameters"]["fx"]["sigma"]
    network = observed()
    prior = dataclasses.replace(network.cameras[0], sigma={"fx": s})
    of_camera = jaxbundle.adjust(network.replace(cameras=(prior,)))
    at_start = jaxbundle.adjust(observed(("cam", "fx", start, s)))
    np.testing.assert_allclose(focal_lengths(at_start), focal_lengths(of_camera), rtol=1e-9)
    elsewhere = jaxbundle.adjust(observed(("cam", "fx", 905.0, s)))
    q = cofactors_of_focal_lengths(apart, elsewhere.values)[0, 0]
    pull = q / (q + s**2) * (905.0 - focal_lengths(apart)[0])
    assert pull > 0.5
    moved = focal_lengths(elsewhere)[0] - focal_lengths(apart)[0]
    assert moved == pytest.approx(pull, rel=0.05)
    assert elsewhere.redundancy == apart.redundancy + 1
    assert elsewhere.residuals["kind"].tolist().count("camera parameters") == 1


@pytest.mark.further
@pytest.mark.parametrize("sigma", [1e-8, 3e-4])
def test_an_observed_ratio_moves_the_focal_lengths_towards_each_other(apart, sigma):
    """fy/fx − 1 becomes σ²/(σ² + q) of what it was, q its cofactor; nothing for σ → 0."""
    found = jaxbundle.adjust(observed(("cam", "fy/fx", 1.0, sigma)))
    fx, fy = focal_lengths(found)
    slope = np.array([-fy / fx**2, 1 / fx])
    q = slope @ cofactors_of_focal_lengths(apart, found.values) @ slope
    before = np.divide(*focal_lengths(apart)[::-1]) - 1
    assert abs(before) > 1e-5
    assert fy / fx - 1 == pytest.approx(before * sigma**2 / (sigma**2 + q), rel=0.05, abs=1e-10)
    if sigma < 1e-6:
        tied = jaxbundle.adjust(ties_network().network)
        np.testing.assert_allclose(focal_lengths(found), focal_lengths(tied), rtol=1e-7)


def test_jacobians():
    rows = ("cam", "fy/fx", 1.0, 1e-3), ("cam", "k1", 0.0, 0.1)
    found = jaxbundle.adjust(observed(*rows))
    check_jacobians(found.problem, found.values)


@pytest.mark.parametrize("row, message", [
    (("cmm", "fx", 900.0, 1.0), "camera 'cmm' is unknown; did you mean 'cam'"),
    (("cam", "fz", 900.0, 1.0), "camera 'cam' has no 'fz'"),
    (("cam", "fx/fy/cx", 1.0, 1.0), "expected a parameter or a ratio of two, such as fy/fx"),
    (("cam", "k2", 0.0, 1.0), "k2 of camera 'cam' cannot change: expected k2 to be free"),
    (("cam", "fx", 900.0, -1.0), "sigma is -1; it must be positive"),
    (("cam", "fx", 900.0, 1e200), r"sigma is 1e\+200; it must be between 1e-75"),
])  # fmt: skip
def test_what_cannot_be_observed_is_refused(row, message):
    with pytest.raises(InputError, match=message):
        for one in (network := observed(row)).further:
            one.check(network)


def test_a_ratio_of_tied_parameters_is_refused():
    columns = {"camera": ["cam"], "parameter": ["fy/fx"], "value": [1.0], "sigma": [1e-3]}
    network = ties_network().network
    (one,) = make_further({"camera_parameters": columns}, 1.0)
    with pytest.raises(InputError, match="to be free and not tied"):
        one.check(network)


def test_observed_parameters_are_written_and_read(tmp_path):
    network = observed(("cam", "fx", 900.0, 5.0), ("cam", "fy/fx", 1.0, 2e-4))
    jaxbundle.write_project(network, tmp_path)
    (again,) = jaxbundle.read_network(tmp_path).further
    (given,) = network.further
    for name, column in given.columns(1.0).items():
        assert list(again.columns(1.0)[name]) == list(column)
