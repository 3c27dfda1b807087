"""Datum points of a reconstruction: well determined, spread, and without effect on what no datum
changes."""

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest

import jaxbundle
from jaxbundle import Camera, grid_of_targets, ring_of_stations, simulate
from jaxbundle.network.subsets import keep_points
from jaxbundle.reconstruction.datum import choose_datum_points


def with_a_distant_point():
    """Six photographs of 49 targets, and a distant point in two of them."""
    targets = grid_of_targets(7, 7, 0.5, relief=0.3, seed=1)
    targets = np.vstack([targets, [[0.3, 0.2, -40.0]]])
    camera = Camera("cam", "brown", {"c": 24.0}, free=("c",))
    stations = ring_of_stations(6, 2.5, 6.0, roll_every=2)
    network = simulate(stations, targets, camera, noise=0.002, seed=3, datum="inner")
    rays, last = network.observations, len(network.points) - 1
    keep = (rays.point != last) | (rays.image < 2)
    return network.replace(observations=rays.take(keep))


@pytest.mark.further
def test_distant_points_of_two_rays_do_not_define_the_datum():
    network = with_a_distant_point()
    distant = network.points.id[-1]
    all_points = jaxbundle.adjust(network)
    chosen = choose_datum_points(all_points)
    assert distant not in chosen and len(chosen) >= 12
    result = jaxbundle.adjust(network.replace(datum_points=chosen))
    free = lambda r: r.cameras["cam"]["parameters"]["c"]
    for name in ("value", "sigma"):
        np.testing.assert_allclose(free(result)[name], free(all_points)[name], rtol=1e-6)
    sigma = lambda r: np.sqrt(np.trace(r.image_covariance[:, :3, :3], axis1=1, axis2=2))
    assert (sigma(result) < 0.5 * sigma(all_points)).all()
    # as good as without the distant point, whose rays add something
    without = keep_points(network, np.array([id != distant for id in network.points.id]))
    near = jaxbundle.adjust(without.replace(datum_points=chosen))
    assert (sigma(result) < 1.02 * sigma(near)).all()


def test_distant_points_of_all_photographs_do_not_define_the_datum():
    """Their rays are nearly parallel; one that is alone in its part of the photographs, too."""
    targets = np.vstack([grid_of_targets(7, 7, 0.5, relief=0.3, seed=1), [[60.0, 10.0, -200.0]]])
    camera = Camera("cam", "brown", {"c": 24.0}, free=("c",))
    network = simulate(ring_of_stations(6, 2.5, 6.0), targets, camera, noise=0.0, datum="inner")
    assert np.bincount(network.observations.point).tolist() == [6] * 50
    problem = jaxbundle.make_problem(network)
    chosen = choose_datum_points(SimpleNamespace(problem=problem, values=problem.data.start))
    assert network.points.id[-1] not in chosen and len(chosen) >= 12


def test_every_photograph_has_datum_points_in_all_its_parts():
    network = with_a_distant_point()
    chosen = set(choose_datum_points(jaxbundle.adjust(network)))
    rays, ids = network.observations, np.array(network.points.id)
    for k in range(len(network.images)):
        seen = rays.point[rays.image == k]
        assert len(chosen & set(ids[seen])) >= 9


def test_a_datum_given_by_control_is_left_alone():
    network = with_a_distant_point()
    images = network.images
    held = dataclasses.replace(images, sigma=np.full((len(images), 6), 0.01))
    result = jaxbundle.adjust(network.replace(images=held, datum="control"))
    assert choose_datum_points(result) == ()
    points = network.points
    role = tuple("fixed" if k < 4 else role for k, role in enumerate(points.role))
    fixed = dataclasses.replace(points, role=role)
    assert choose_datum_points(jaxbundle.adjust(network.replace(points=fixed))) == ()
