"""Cameras mounted together, in a network of targets with other images."""

import dataclasses

import numpy as np
import pytest
from further_checks import check_jacobians, sample
from scipy.spatial.transform import Rotation

import jaxbundle
from jaxbundle.batches.population import Population
from jaxbundle.batches.work import network_row
from jaxbundle.errors import InputError
from jaxbundle.geometry import matrix_from_omega_phi_kappa, omega_phi_kappa_from_matrix
from jaxbundle.network.build import make_further
from jaxbundle.network.tables import Distances
from jaxbundle.planning.stations import Stations

T = np.array([0.3, 0.02, -0.01])
R = Rotation.from_euler("xyz", [0.02, -0.1, 0.05]).as_matrix()
EPOCHS = 5


@pytest.fixture(scope="module")
def simulated():
    """Left and right camera at five epochs, and three photographs of a third camera."""
    left = jaxbundle.ring_of_stations(EPOCHS, radius=4.0, height=2.0, roll_every=2)
    other = jaxbundle.ring_of_stations(3, radius=5.0, height=1.0)
    M = np.array([np.asarray(matrix_from_omega_phi_kappa(a)) for a in left.angles])
    right = Stations(
        left.position + M.transpose(0, 2, 1) @ T,
        np.array([np.asarray(omega_phi_kappa_from_matrix(R @ m)) for m in M]),
    )
    camera = lambda id, c: jaxbundle.Camera(id, "brown", {"c": c}, ("c",))
    return jaxbundle.simulate_with_truth(
        left + right + other, jaxbundle.cloud_of_targets(25, 1.5, seed=4),
        [camera("left", 20.0), camera("right", 22.0), camera("single", 28.0)],
        camera_of_station=[0] * EPOCHS + [1] * EPOCHS + [2] * 3, noise=0.002, seed=2,
        disturb=(0.01, 0.002, 0.01),
    )  # fmt: skip


def mounted(network, rows=None, **section):
    ids = network.images.id
    rows = rows or [
        {"rig": "pair", "epoch": str(e), "image": ids[e + k * EPOCHS]}
        for k in (0, 1) for e in range(EPOCHS)
    ]  # fmt: skip
    further = make_further({"rigs": rows, "rig": {"reference": "left"} | section}, 1.0)
    for one in further:
        one.check(network)
    return network.replace(further=further)


@pytest.fixture(scope="module")
def result(simulated):
    return jaxbundle.adjust(mounted(simulated.network))


def test_the_mounting_is_found(simulated, result):
    alone = jaxbundle.adjust(simulated.network)
    assert result.converged and 0.8 < result.sigma0 < 1.2
    assert result.redundancy == alone.redundancy + 6 * EPOCHS - 6
    assert result.counts.datum == 7  # the scale of a mounting is that of the network
    found = result.further_unknowns["mounting"]["right of pair"]
    size = result.point_values.std() / simulated.truth.points.position.std()
    expected = [*T * size, *np.asarray(omega_phi_kappa_from_matrix(R))]
    for (name, one), value in zip(found.items(), expected):
        assert one["sigma"] > 0
        # A free network's scale is that of its start values, known to one part in 400 here.
        assert abs(one["value"] - value) < 4 * one["sigma"] + 1e-3 * abs(value), name
    zero = result.further_unknowns["mounting"]["left of pair"]
    assert all(one["value"] == one["sigma"] == 0 for one in zero.values())
    # Fewer unknowns: what both determine is better known.
    c = lambda r: r.cameras["right"]["parameters"]["c"]["sigma"] / r.sigma0
    assert c(result) < c(alone)
    assert "Mounting" in result.report()


@pytest.mark.further
def test_in_a_batch(simulated, result, tmp_path):
    """The line of a rig names its mountings, and they are part of the population."""
    path = jaxbundle.write_project(mounted(simulated.network), tmp_path / "pair")
    row = network_row(str(path), max_iterations=100)
    of = row["further_unknowns"]["mounting"]["right of pair"]
    expected = result.further_unknowns["mounting"]["right of pair"]
    for name, one in expected.items():
        assert of[name]["value"] == pytest.approx(one["value"], abs=1e-6 * one["sigma"])
        assert of[name]["sigma"] == pytest.approx(one["sigma"], rel=1e-6)
    table = Population([row | {"key": str(k)} for k in range(2)]).table()
    for name in expected:
        assert table[f"mounting right of pair {name}"].tolist() == [of[name]["value"]] * 2
    assert table["sigma_left c"][0] == row["cameras"]["left"]["parameters"]["c"]["sigma"]


def test_mountings_are_equal(result):
    """Exactly: the relative orientations of all epochs, to a thousandth of their σ."""
    position, M = result.image_values[:, :3], None
    M = np.array([np.asarray(matrix_from_omega_phi_kappa(a)) for a in result.image_values[:, 3:]])
    t = np.array([M[e] @ (position[e + EPOCHS] - position[e]) for e in range(EPOCHS)])
    relative = np.array([M[e + EPOCHS] @ M[e].T for e in range(EPOCHS)])
    assert np.abs(t - t[0]).max() < 1e-6 and np.abs(relative - relative[0]).max() < 1e-6


def test_jacobians(result):
    check_jacobians(result.problem, result.values)


def test_sigma_is_that_of_a_sample(simulated, result):
    problem = jaxbundle.make_problem(mounted(simulated.truth))
    found = sample(problem, problem.data.start, ("camera",))["camera"][:, :, 0]
    sigma = np.array([result.cameras[c.id]["parameters"]["c"]["sigma"]
                      for c in result.network.cameras]) / result.sigma0  # fmt: skip
    ratio = found.std(0) / sigma
    assert (np.abs(ratio - 1) < 4 / np.sqrt(2 * len(found))).all(), ratio


@pytest.mark.further
def test_a_mounting_that_works_loose(simulated):
    """With a σ the epochs may differ: their residuals have it."""
    section = {"sigma_position": 1e-3, "sigma_angle": 1e-3}
    with pytest.raises(InputError, match="a σ of rigs is a length, but nothing gives the"):
        jaxbundle.adjust(mounted(simulated.network, **section))
    X = simulated.truth.points.position
    length = np.linalg.norm(X[:1] - X[1:2], axis=1)
    scale = Distances(np.array([[0, 1]]), length, np.array([1e-4]))
    loose = jaxbundle.adjust(mounted(simulated.network.replace(distances=scale), **section))
    component = loose.variance_components["mountings"]
    assert component.observations == 6 * EPOCHS and component.redundancy > 10
    assert component.sigma < 1.0  # they do not differ, in truth


@pytest.mark.parametrize("unit", [1.0, 1e-6])
def test_an_open_scale_is_seen_in_any_unit(simulated, unit):
    network = simulated.truth
    scaled = lambda table: dataclasses.replace(table, position=table.position / unit)
    network = network.replace(points=scaled(network.points), images=scaled(network.images))
    with pytest.raises(InputError, match="a σ of rigs is a length, but nothing gives the"):
        jaxbundle.make_problem(mounted(network, sigma_position=1e-3))


@pytest.mark.parametrize("rows, section, message", [
    ([("a", "1", 0), ("a", "1", 1)], {}, "camera 'left' has two images at epoch '1'"),
    ([("a", "1", 0), ("a", "2", EPOCHS)], {}, "no epoch has images of two cameras"),
    ([("a", "1", 0), ("a", "1", EPOCHS), ("b", "1", 0)], {}, "row 3: .*image .* row 1"),
    ([("a", "1", 0), ("a", "1", EPOCHS)], {"reference": "middle"}, "there is no such camera"),
    ([("a", "1", 0), ("a", "1", EPOCHS)], {"sigma_angle": 0}, "sigma_angle"),
])  # fmt: skip
def test_what_is_wrong_is_named(simulated, rows, section, message):
    ids = simulated.network.images.id
    rows = [{"rig": rig, "epoch": epoch, "image": ids[i]} for rig, epoch, i in rows]
    with pytest.raises(InputError, match=message):
        jaxbundle.make_problem(mounted(simulated.network, rows, **section))


@pytest.mark.further
def test_residuals_of_angles_have_the_unit_of_the_network(simulated):
    """Those of mountings, of attitudes and of measured angles, and no others."""
    network = mounted(simulated.network)
    ids, points = network.images.id, network.points.id
    angles = np.degrees(simulated.truth.images.angles[0])
    rows = {
        "attitudes": [{"image": ids[0], **dict(zip(("omega", "phi", "kappa"), angles)),
                       **dict.fromkeys(("somega", "sphi", "skappa"), 1.0)}],
        "angles": [{"from": points[0], "at": points[1], "to": points[2], "value": 60.0,
                    "sigma": 30.0}],
    }  # fmt: skip
    more = make_further(rows, np.radians(1.0))
    network = network.replace(further=(*network.further, *more))
    radians, gon = (
        jaxbundle.adjust(network.replace(angle_unit=unit)).residuals for unit in ("rad", "gon")
    )
    turned = gon["unit"] == "gon"
    expected = {"turn x", "turn y", "turn z", "omega", "phi", "kappa", "angle"}
    assert {*gon["axis"][turned]} == expected == {*radians["axis"][radians["unit"] == "rad"]}
    for name in ("v", "sigma", "mdb"):
        factor = np.where(turned, 200 / np.pi, 1.0)
        np.testing.assert_allclose(gon[name], factor * radians[name], rtol=1e-7)
    assert {*gon["unit"][gon["kind"] == "image"]} == {network.image_unit}


def test_counts_name_every_kind(simulated, result):
    told = next(line for line in result.report().splitlines() if "Pseudo-observations" in line)
    assert f"mountings {6 * EPOCHS}" in told and str(result.counts.other) == str(6 * EPOCHS)
