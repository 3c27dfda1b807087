"""A network that its control hardly holds: steps that move it as one."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxbundle
from jaxbundle.geometry import matrix_from_quaternion
from jaxbundle.leastsquares.datum.by_table import directions_of_motions
from jaxbundle.leastsquares.datum.conditions import of_groups
from jaxbundle.leastsquares.iterations.stopping import converged
from jaxbundle.leastsquares.problem import pad_values
from jaxbundle.leastsquares.solution import find_minimum

TILT = 0.3


@pytest.fixture(scope="module")
def weak():
    """A block with four control points within 16 m, of σ 5 m: rotations are uncertain by some 20
    degrees, and the start values are turned by 17."""
    camera = jaxbundle.Camera("cam", "brown", {"c": 20.0}, ())
    stations = jaxbundle.ring_of_stations(6, 30.0, 25.0)
    targets = jaxbundle.grid_of_targets(6, 6, 8.0, relief=4.0)
    made = jaxbundle.simulate_with_truth(stations, targets, camera, noise=1e-4, seed=3)
    points = made.network.points
    rows = [0, 1, 2, 12]
    rng = np.random.default_rng(0)
    given = made.truth.points.position[rows] + rng.normal(size=(4, 3))
    position, sigma = points.position.copy(), np.full((len(points), 3), np.nan)
    role = ["tie"] * len(points)
    turn = np.array([[1, 0, 0], [0, np.cos(TILT), -np.sin(TILT)], [0, np.sin(TILT), np.cos(TILT)]])
    pivot = made.truth.points.position[rows].mean(0)
    position = (position - pivot) @ turn.T + pivot
    for row, X in zip(rows, given):
        role[row], position[row], sigma[row] = "control", X, [5.0, 5.0, 5.0]
    images = made.network.images
    M = [np.asarray(jaxbundle.geometry.matrix_from_omega_phi_kappa(a)) for a in images.angles]
    angles = [jaxbundle.geometry.omega_phi_kappa_from_matrix(m @ turn.T) for m in M]
    images = dataclasses.replace(
        images, position=(images.position - pivot) @ turn.T + pivot, angles=np.array(angles)
    )
    points = dataclasses.replace(points, role=tuple(role), position=position, sigma=sigma)
    return made.network.replace(points=points, images=images, datum="control")


def test_it_moves_as_one(weak):
    problem = jaxbundle.make_problem(weak)
    assert problem.retraction.moves_as_one
    straight = dataclasses.replace(
        problem, retraction=dataclasses.replace(problem.retraction, moves_as_one=False)
    )
    found, crept = (find_minimum(p, p.data.start) for p in (problem, straight))
    assert converged(found.termination)
    assert int(found.iterations) < 0.5 * int(crept.iterations)


def test_a_similarity_moves_no_ray(weak):
    """A step that is a similarity to first order becomes a finite one: rays stay, to rounding;
    straight steps move them by its second order."""
    problem = jaxbundle.make_problem(weak)
    motion = np.array([1.0, -2.0, 3.0, 0.2, -0.1, 0.3, 0.05])
    values = pad_values(problem, problem.data.start)
    moves = of_groups(problem.plan, directions_of_motions(problem.declared, values))
    step = {name: jnp.asarray(x) @ motion for name, x in moves.items()}
    start = rays(values, weak)
    moved = rays(problem.retraction(problem.plan, values, step), weak)
    np.testing.assert_allclose(moved, start, atol=1e-12)
    straight = dataclasses.replace(problem.retraction, moves_as_one=False)
    assert np.abs(rays(straight(problem.plan, values, step), weak) - start).max() > 1e-3


def rays(values, network):
    """Tangents of all rays."""
    observations = network.observations
    M = jax.vmap(matrix_from_quaternion)(jnp.asarray(values["image"].rotation))
    X = jnp.asarray(values["point"])[observations.point, :3]
    centres = jnp.asarray(values["image"].position)[observations.image]
    x, y, z = jnp.einsum("nij,nj->in", M[observations.image], X - centres)
    return np.stack([x / z, y / z])
