"""The adjusted network: adjusted again it does not change, and other programs can read it."""

import dataclasses

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

import jaxbundle
from jaxbundle.cli.outputs import NETWORK_FILES, check_targets, write_targets
from jaxbundle.io import adjusted_network, read_network, write_project
from jaxbundle.io.networks.orientation_covariance import read_orientation_covariance
from jaxbundle.leastsquares.problem import with_data
from jaxbundle.network.camera_tables import with_start


def test_it_is_a_fixed_point(convergent4, tmp_path):
    network = adjusted_network(convergent4)
    assert network.datum == "inner" and network.cameras[0].free == convergent4.network.cameras[
        0].free  # fmt: skip
    assert_array_equal(network.points.position, convergent4.point_values)
    back = read_network(write_project(network, tmp_path))
    again = jaxbundle.adjust(back)
    assert again.sigma0 == pytest.approx(convergent4.sigma0, rel=1e-9)
    assert again.iterations <= 3
    scale = np.ptp(convergent4.point_values)
    assert_allclose(again.point_values, convergent4.point_values, atol=1e-6 * scale)
    before, after = (r.camera_parameters("cam") for r in (convergent4, again))
    for name, value in before.items():
        assert after[name] == pytest.approx(value, rel=1e-4), name


def test_removed_and_held_things(convergent4):
    weight = np.array(convergent4.problem.data.weight["image"])
    gone = 7
    weight[gone] = 0
    problem = convergent4.problem
    problem = with_data(problem, problem.with_image_weights(problem.data, weight))
    result = jaxbundle.Adjustment(convergent4.network, problem, convergent4.minimum)
    rays, kept = convergent4.problem.network.observations, adjusted_network(result).observations
    assert len(kept) == len(rays) - 1
    assert_array_equal(kept.xy, np.delete(rays.xy, gone, axis=0))


def test_it_is_written_with_the_result_and_read_from_its_folder(convergent4, tmp_path):
    write_targets(convergent4, "", tmp_path, brief=True, plots=False)
    folder = tmp_path / "network"
    needed = {"project.toml", "images.csv", "points.csv", "observations.csv"}
    assert {p.name for p in folder.iterdir()} == needed | {"precision.csv"}
    assert needed < set(NETWORK_FILES)
    network = read_network(tmp_path)
    precision = read_orientation_covariance(folder / "precision.csv", 1.0)
    for k, id in enumerate(network.images.id):
        rows = precision.rows(id, "cam", ["c", "K1"])
        C = precision.matrix[np.ix_(rows, rows)]
        of_image, of_camera = convergent4.image_covariance[k], convergent4.cameras["cam"]
        unit = np.sqrt(np.outer(of_image.diagonal(), of_image.diagonal()))
        assert_allclose(C[:6, :6] / unit, of_image / unit, atol=1e-9)
        sigma = [of_camera["parameters"][name]["sigma"] for name in ("c", "K1")]
        assert_allclose(np.sqrt(C.diagonal()[6:]), sigma, rtol=1e-9)
    assert_allclose(network.images.position, convergent4.image_values[:, :3], rtol=1e-15)
    with pytest.raises(jaxbundle.InputError, match="part of the input and would be overwritten"):
        check_targets(tmp_path / "network" / "project.toml", network, "", tmp_path)
    write_targets(jaxbundle.NotSolvedError("why"), "", tmp_path, brief=True, plots=False)
    left = {".jaxbundle", "report.txt", "report.html", "result.json"}
    assert {p.name for p in tmp_path.iterdir()} == left


def test_a_prior_observes_its_value_whatever_the_start(convergent4, tmp_path):
    """Of a camera that starts at its adjusted values, by way of a project."""
    network = convergent4.network
    # The fixture weighs image points by 1, a σ of 1 mm: this one is of their weight.
    camera = dataclasses.replace(network.cameras[0], sigma={"c": 50.0})
    found = jaxbundle.adjust(network.replace(cameras=(camera,)))
    values = found.camera_parameters("cam")
    assert abs(values["c"] - camera.parameters["c"]) > 1e-4
    restarted = with_start(camera, values)
    assert restarted.parameters == values and restarted.observed == {"c": camera.parameters["c"]}
    back = read_network(write_project(network.replace(cameras=(restarted,)), tmp_path))
    again = jaxbundle.adjust(back)
    assert again.sigma0 == pytest.approx(found.sigma0, rel=1e-9)
    assert again.camera_parameters("cam")["c"] == pytest.approx(values["c"], rel=1e-9)
    unobserved = dataclasses.replace(camera, observed={"K1": 0.0})
    with pytest.raises(jaxbundle.InputError, match="observed is given for 'K1', which has no si"):
        jaxbundle.check_network(network.replace(cameras=(unobserved,)))
