"""Unsolvable problems end with the name of the defect, never as converged."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
from adjustment_checks import solved, synthetic

from jaxbundle.adjustment.problem import make_problem
from jaxbundle.leastsquares.iterations.stopping import (
    LIMIT,
    NOT_FINITE,
    RELATIVE_COST,
    SETTLED,
    SINGULAR,
    STUCK,
    TERMINATIONS,
    converged,
)
from jaxbundle.leastsquares.problem import hold
from jaxbundle.network import Camera


def problem_of(scene, *, hold_scale=True, hold_images=False, noise=1.0):
    """One structure for all: c and the linear K0 of a camera in the measured image, four fixed
    points; what is held is decided by arrays, so that the solver is compiled once."""
    camera = Camera("cam", "usgs", {"c": 150.0}, free=("c", "K0"))
    network, _ = synthetic(
        cameras=(camera,), fixed=4, points=12, domain="measured", scene=scene, noise=noise
    )
    problem = make_problem(network)
    columns = [0, 1] if hold_images else [1] if hold_scale else []
    problem = hold(problem, "camera", [0], np.array(columns, int))
    return hold(problem, "image", np.arange(6 if hold_images else 0))


def test_the_same_network_is_solved_where_it_is_determined():
    assert int(solved(problem_of("ring")).termination) == SETTLED


def test_two_parameters_that_do_the_same():
    # x = −c·r/q/(1 + K0): only c/(1 + K0) can be found, at any values of the unknowns.
    problem = problem_of("ring", hold_scale=False)
    assert int(solved(problem).termination) == SINGULAR


def test_principal_distance_from_vertical_images_of_flat_ground():
    # c and the flying height do the same where all points have one height.
    problem = problem_of("vertical", noise=0.0)
    assert int(solved(problem).termination) == SINGULAR


def test_points_seen_from_one_place():
    # Every point may lie anywhere on its ray.
    problem = problem_of("one centre", hold_images=True)
    centre = problem.data.start["image"].position
    image = problem.data.start["image"]._replace(
        position=jnp.broadcast_to(centre[0], centre.shape)
    )
    start = problem.data.start | {"image": image}
    data = dataclasses.replace(problem.data, start=start)
    assert int(solved(problem, data).termination) == SINGULAR


@pytest.mark.parametrize("of", ["image", "point"])
def test_an_unknown_that_nothing_observes(of):
    problem = problem_of("ring")
    rays = getattr(problem, of) == {"image": 2, "point": 8}[of]
    weight = jnp.where(rays[:, None], 0.0, problem.data.weight["image"])
    data = problem.with_image_weights(problem.data, weight)
    assert int(solved(problem, data).termination) == SINGULAR


def test_start_values_that_are_not_finite():
    problem = problem_of("ring")
    point = problem.data.start["point"].at[7, 1].set(jnp.nan)
    data = dataclasses.replace(problem.data, start=problem.data.start | {"point": point})
    assert int(solved(problem, data).termination) == NOT_FINITE


def test_every_reason_has_words():
    reasons = (LIMIT, SETTLED, RELATIVE_COST, SINGULAR, STUCK, NOT_FINITE)
    assert reasons == tuple(range(len(TERMINATIONS)))
    assert [bool(converged(reason)) for reason in reasons] == [0, 1, 1, 0, 0, 0]
