"""Clinometer readings and azimuths of images, and what they give a free network."""

import dataclasses

import numpy as np
import pytest
from further_checks import check_jacobians, sample

import jaxbundle
from jaxbundle.errors import InputError
from jaxbundle.geometry import matrix_from_omega_phi_kappa
from jaxbundle.network.build import make_further

N, SIGMA = 6, 1e-4
AXIS = {"right": np.array([1.0, 0, 0]), "up": np.array([0, 1.0, 0]), "view": np.array([0, 0, -1.0])}
CAMERA = jaxbundle.Camera("cam", "brown", {"c": 20.0}, ())


@pytest.fixture(scope="module")
def free():
    """A free network with a scale, of cameras that look nearly horizontally."""
    return jaxbundle.simulate_with_truth(
        jaxbundle.ring_of_stations(N, radius=4.0, height=0.5, roll_every=0),
        jaxbundle.cloud_of_targets(30, 1.5, seed=4), CAMERA, noise=0.002, seed=2,
        distances=((0, 5), (3, 9)), distance_sigma=1e-3,
    )  # fmt: skip


def directions(network, axis):
    M = [np.asarray(matrix_from_omega_phi_kappa(a)) for a in network.images.angles]
    return np.array([m.T @ AXIS[axis] for m in M])


def tilts(made, axes=("right", "view"), noise=0.0, zero=0.0, rows=N, sigma=SIGMA):
    """Elevations by arcsin of the vertical component."""
    random = np.random.default_rng(5)
    table = {"image": list(made.truth.images.id)[:rows]}
    for axis in axes:
        e = np.arcsin(directions(made.truth, axis)[:rows, 2])
        table[axis] = e + zero + noise * sigma * random.normal(size=rows)
        table[f"s{axis}"] = [sigma] * rows
    return table


def azimuths(made, axis="view", noise=0.0, declination=0.0, rows=N, sigma=SIGMA):
    """Clockwise from Y, by complex numbers."""
    random = np.random.default_rng(6)
    d = directions(made.truth, axis)[:rows]
    value = np.angle(d[:, 1] + 1j * d[:, 0]) - declination
    value = value + noise * sigma * random.normal(size=rows)
    return {"image": list(made.truth.images.id)[:rows], "value": value, "sigma": [sigma] * rows,
            "axis": [axis] * rows}  # fmt: skip


def rotated(network, angles):
    """The whole network in another frame."""
    R = np.asarray(matrix_from_omega_phi_kappa(np.array(angles)))
    M = [np.asarray(matrix_from_omega_phi_kappa(a)) @ R.T for a in network.images.angles]
    turned = [np.asarray(jaxbundle.geometry.omega_phi_kappa_from_matrix(m)) for m in M]
    return network.replace(
        images=dataclasses.replace(
            network.images, position=network.images.position @ R.T, angles=np.array(turned)),
        points=dataclasses.replace(network.points, position=network.points.position @ R.T),
    )  # fmt: skip


def test_tilts_level_a_network_and_azimuths_orient_it(free):
    """From start values in a frame that is tilted by 3° and turned by 6°."""
    network = rotated(free.network, (0.05, -0.04, 0.1)).replace(datum="inner")
    assert jaxbundle.make_problem(network).counts.datum == 6
    level = jaxbundle.add_further(network, tilts=tilts(free, noise=1.0))
    assert jaxbundle.make_problem(level).counts.datum == 4
    both = jaxbundle.add_further(level, azimuths=azimuths(free, noise=1.0))
    assert jaxbundle.make_problem(both).counts.datum == 3
    result = jaxbundle.adjust(both)
    assert result.converged and 0.8 < result.sigma0 < 1.2
    # but for the three shifts the points are those of the truth
    found, true = result.point_values, free.truth.points.position
    assert np.abs((found - found.mean(0)) - (true - true.mean(0))).max() < 2e-3
    assert "tilts" in result.variance_components and "azimuths" in result.variance_components


@pytest.mark.further
def test_zero_errors_and_the_declination_are_found(free):
    """From images of four directions: beside control, that gives their true tilts."""
    points = dataclasses.replace(
        free.truth.points, role=("fixed",) * 5 + free.truth.points.role[5:])  # fmt: skip
    network = free.network.replace(points=dataclasses.replace(
        points, position=np.where(np.arange(len(points))[:, None] < 5, points.position,
                                  free.network.points.position)), datum="control")  # fmt: skip
    network = jaxbundle.add_further(
        network, tilts=tilts(free, noise=1.0, zero=0.02), tilt={"free": ["right", "view"]},
        azimuths=azimuths(free, noise=1.0, declination=0.3),
        azimuth={"declination": 0.2, "free": ["declination"], "sigma": {"declination": 0.2}},
    )  # fmt: skip
    result = jaxbundle.adjust(network)
    found = result.further_unknowns
    for table, name, true in (("clinometer", "zero right", 0.02), ("clinometer", "zero view", 0.02),
                              ("declination", "declination", 0.3)):  # fmt: skip
        one = found[table]["cam"][name]
        assert abs(one["value"] - true) < 4 * one["sigma"] < 0.01, name
    assert found["clinometer"]["cam"]["zero up"] == {"value": 0.0, "sigma": 0.0}


@pytest.mark.further
def test_sigma_is_that_of_a_sample(free):
    """200 draws of everything measured, of the zero errors."""
    points = free.truth.points
    fixed = dataclasses.replace(points, role=("fixed",) * 5 + points.role[5:])
    network = jaxbundle.add_further(
        free.truth.replace(points=fixed, datum="control"), tilts=tilts(free),
        tilt={"free": ["right", "view"]}, azimuths=azimuths(free),
        azimuth={"free": ["declination"]},
    )  # fmt: skip
    problem = jaxbundle.make_problem(network)
    found = sample(problem, problem.data.start, ("clinometer", "declination"), draws=200)
    rays = free.network.observations
    result = jaxbundle.adjust(network.replace(observations=rays))
    zero = result.further_unknowns["clinometer"]["cam"]
    sigma = [zero[f"zero {axis}"]["sigma"] / result.sigma0 for axis in ("right", "view")]
    sigma.append(result.further_unknowns["declination"]["cam"]["declination"]["sigma"]
                 / result.sigma0)  # fmt: skip
    drawn = np.c_[found["clinometer"][:, 0, [0, 2]], found["declination"][:, 0]]
    ratio = drawn.std(0, ddof=1) / sigma
    assert (ratio > 0.88).all() and (ratio < 1.12).all(), ratio


@pytest.mark.further
def test_a_camera_that_looks_down_is_levelled_by_its_other_axes():
    down = jaxbundle.simulate_with_truth(
        jaxbundle.aerial_block(2, 3, height=50.0, footprint=(60.0, 40.0)),
        np.random.default_rng(3).uniform([-50, -40, -3], [50, 40, 3], (60, 3)), CAMERA,
        noise=0.002, distances=((0, 5),), disturb=(0.1, 0.01, 0.1),
    )  # fmt: skip
    rows = len(down.network.images)
    network = jaxbundle.add_further(
        down.network, tilts=tilts(down, ("right", "up"), 1.0, rows=rows),
        azimuths=azimuths(down, "up", 1.0, rows=rows),
    )  # fmt: skip
    result = jaxbundle.adjust(network)
    assert result.converged and 0.8 < result.sigma0 < 1.2
    difference = result.image_values[:, 3:] - down.truth.images.angles
    assert np.abs(np.sin(difference)).max() < 2e-3


@pytest.mark.further
def test_azimuths_are_on_the_circle(free):
    """359° and 1°: turned by whole turns they are the same observations."""
    rows = azimuths(free, noise=1.0)
    one = jaxbundle.adjust(jaxbundle.add_further(free.network, azimuths=rows))
    turned = rows | {"value": rows["value"] + 2 * np.pi * np.arange(N)}
    two = jaxbundle.adjust(jaxbundle.add_further(free.network, azimuths=turned))
    np.testing.assert_allclose(two.point_values, one.point_values, atol=1e-9)


@pytest.mark.parametrize("axes", [("right",), ("right", "view")])
def test_a_row_has_as_many_equations_as_readings(free, axes):
    (table,) = make_further({"tilts": tilts(free, axes)}, 1.0)
    assert table.number_of_equations() == len(axes)


def test_jacobians(free):
    network = jaxbundle.add_further(
        free.network, tilts=tilts(free), tilt={"free": ["view"], "sigma": {"view": 0.1}},
        azimuths=azimuths(free), azimuth={"free": ["declination"], "sigma": {"declination": 0.1}},
    )  # fmt: skip
    problem = jaxbundle.make_problem(network)
    check_jacobians(problem, problem.data.start)


def test_readings_are_simulated(free):
    given = jaxbundle.add_further(free.network, tilts=tilts(free, zero=0.5))
    (found,) = jaxbundle.simulate_further(given, free.truth, seed=3).further
    true = np.stack([tilts(free)["right"], np.zeros(N), tilts(free)["view"]], 1)
    error = (found.elevation - true)[:, [0, 2]] / SIGMA
    assert 0.5 < error.std() < 1.6 and np.abs(error).max() < 4


@pytest.mark.parametrize("tables, message", [
    ({"tilts": {"image": ["1"], "right": [0.1]}}, "expected right and sright"),
    ({"tilts": {"image": ["1"]}}, "nothing was read"),
    ({"tilts": {"image": ["1"], "up": [1.5], "sup": [0.1]}}, "near to the vertical"),
    ({"tilts": {"image": ["x"], "up": [0.5], "sup": [0.1]}}, "image 'x' is unknown"),
    ({"tilts": {"image": ["1"], "up": [0.5], "sup": [-0.1]}}, "sup is -0.1"),
    ({"tilts": {"image": ["1"], "up": [0.5], "sup": [0.1]}, "tilt": {"free": ["roll"]}},
     "unknown 'roll'"),
    ({"azimuths": {"image": ["1"], "value": [1.0], "sigma": [0.1], "axis": ["viev"]}},
     "axis is 'viev'; did you mean 'view'"),
    ({"azimuths": {"image": ["1"], "value": [1.0], "sigma": [0.1]},
      "azimuth": {"declination": "east"}}, "declination"),
])  # fmt: skip
def test_what_is_wrong_is_named(free, tables, message):
    with pytest.raises(InputError, match=message):
        jaxbundle.add_further(free.network, **tables)


def test_in_a_project_and_back(free, tmp_path):
    network = jaxbundle.add_further(
        free.network.replace(angle_unit="deg"), tilts=tilts(free, sigma=0.01),
        tilt={"free": ["view"]}, azimuths=azimuths(free),
        azimuth={"declination": 2.5},
    )  # fmt: skip
    again = jaxbundle.read_network(str(jaxbundle.write_project(network, tmp_path / "p")))
    for one, other in zip(network.further, again.further):
        assert one.settings == other.settings
        for name in ("elevation", "sigma", "value", "axis"):
            if hasattr(one, name):
                np.testing.assert_array_equal(getattr(one, name), getattr(other, name))
