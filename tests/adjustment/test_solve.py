"""The minimum is reached from far away, and is the same by both methods, in any unit and at any
place."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from adjustment_checks import (
    NETWORKS,
    adjusted,
    linearise,
    residuals_of,
    solved,
    synthetic,
    vtpv,
)

from jaxbundle.adjustment.problem import make_problem
from jaxbundle.adjustment.quality.inspection import Inspection
from jaxbundle.adjustment.solve import solve
from jaxbundle.cameras import get_model
from jaxbundle.geometry import (
    matrix_from_omega_phi_kappa,
    matrix_from_quaternion,
    matrix_from_rotation_vector,
    omega_phi_kappa_from_matrix,
)
from jaxbundle.leastsquares.iterations.stopping import SETTLED

SHARED = "cameras of two models"

SAME = 1e-8
"""Two runs to the same minimum differ by rounding of vᵀPv, √1e-15 of σ at most."""


def camera_sigmas(problem, values):
    """A priori σ of the parameters of the shared camera."""
    (Q,) = Inspection(problem, values).camera_cofactors
    return np.sqrt(np.diagonal(Q))


def rotations(values):
    return np.asarray(jax.vmap(matrix_from_quaternion)(values["image"].rotation))


def assert_same_values(a, b, tolerance=SAME):
    """Agreement of two solutions; tolerances in m, radians, and units of the parameters."""
    np.testing.assert_allclose(a["point"], b["point"], atol=tolerance * 1e-2)
    position = a["image"].position, b["image"].position
    np.testing.assert_allclose(*position, atol=tolerance * 1e-1)
    np.testing.assert_allclose(rotations(a), rotations(b), atol=tolerance * 1e-1)
    for name in a.keys() - {"point", "image"}:
        np.testing.assert_allclose(a[name], b[name], atol=tolerance, rtol=tolerance)


@pytest.mark.parametrize("name", [pytest.param(SHARED, marks=pytest.mark.further), "free"])
def test_the_minimum_is_one(name):
    problem, minimum = adjusted(name)
    assert int(minimum.termination) == SETTLED
    # The gradient in scaled unknowns, against the size of what cancels in it.
    dense = linearise(problem, minimum.values)
    size = np.linalg.norm(dense.J, axis=0)
    gradient = (dense.J.T @ dense.v) / np.where(size > 0, size, 1)
    assert np.abs(gradient).max() < 1e-9 * np.linalg.norm(dense.v)
    # σ0 of simulated noise: 1 within four times its standard deviation.
    redundancy = problem.counts.redundancy
    sigma0 = np.sqrt(vtpv(problem, minimum.values) / redundancy)
    assert abs(sigma0 - 1) < 4 / np.sqrt(2 * redundancy)
    cost = np.asarray(minimum.history.cost)[: int(minimum.iterations)]
    taken = cost[np.asarray(minimum.history.accepted)[: int(minimum.iterations)]]
    assert (np.diff(taken) < 1e-12 * taken[1:]).all()


@pytest.mark.further
def test_from_start_values_ten_times_as_bad():
    problem, minimum = adjusted(SHARED)
    worse = make_problem(synthetic(**NETWORKS[SHARED], disturbance=10)[0])
    assert np.abs(worse.data.start["point"] - problem.data.start["point"]).max() > 0.1
    other = solved(worse)
    assert int(other.termination) == SETTLED
    assert_same_values(other.values, minimum.values)


def test_a_free_network_from_other_start_values():
    # Its datum is another one, so only what does not depend on it can be compared.
    problem, minimum = adjusted("free")
    other = make_problem(synthetic(**NETWORKS["free"], disturbance=5)[0])
    found = solved(other)
    assert int(found.termination) == SETTLED
    np.testing.assert_allclose(
        found.values["camera"], minimum.values["camera"], rtol=SAME, atol=1e-11
    )
    rows = [residuals_of(p, m.values) for p, m in ((problem, minimum), (other, found))]
    np.testing.assert_allclose(rows[0], rows[1], atol=1e-7)


def test_all_free_datums_have_the_same_residuals():
    found = [adjusted(name) for name in ("free", "minimal")]
    rows = [residuals_of(problem, minimum.values) for problem, minimum in found]
    np.testing.assert_allclose(rows[0], rows[1], atol=1e-8)


def test_methods_are_named():
    with pytest.raises(ValueError, match="levenberg-marquardt, gauss-newton, not 'newton'"):
        solve(adjusted("free")[0], method="newton")


@pytest.mark.parametrize("name", [SHARED, "free"])
def test_exact_data_give_back_the_truth(name):
    network, truth = synthetic(**NETWORKS[name], noise=0.0)
    problem = make_problem(network)
    minimum = solved(problem)
    assert int(minimum.termination) == SETTLED
    assert vtpv(problem, minimum.values) < 1e-14
    if name != "free":
        X = minimum.values["point"] + problem.origin
        np.testing.assert_allclose(X, truth.point, atol=1e-10)
        np.testing.assert_allclose(rotations(minimum.values), truth.matrix, atol=1e-10)
    for c, camera in enumerate(problem.network.cameras):
        names, moving = problem.free_parameters(c)
        at = [get_model(camera.model).parameters.index(names[k]) for k in moving]
        given = [camera.parameters[names[k]] for k in moving]
        found = np.asarray(problem.interior_orientation(minimum.values))[c, at]
        np.testing.assert_allclose(found, given, rtol=1e-8)


ROTATION, SCALE, SHIFT = np.array([0.4, -0.9, 0.3]), 30.0, np.array([500.0, -200.0, 70.0])


def transformed(network):
    """The network after a similarity of object space: X' = scale·R·X + shift, M' = M·Rᵀ."""
    R = np.asarray(matrix_from_rotation_vector(jnp.asarray(ROTATION)))
    move = lambda X: SCALE * X @ R.T + SHIFT
    images, points = network.images, network.points
    M = np.asarray(jax.vmap(matrix_from_omega_phi_kappa)(jnp.asarray(images.angles))) @ R.T
    angles = np.asarray(jax.vmap(omega_phi_kappa_from_matrix)(jnp.asarray(M)))
    return network.replace(
        images=dataclasses.replace(images, position=move(images.position), angles=angles),
        points=dataclasses.replace(points, position=move(points.position)),
    ), move


def test_a_similarity_of_object_space_changes_nothing_that_is_estimable():
    problem, minimum = adjusted("free")
    network, move = transformed(problem.network)
    other = make_problem(network)
    found = solved(other)
    assert int(found.termination) == SETTLED
    a, b = (residuals_of(p, m.values) for p, m in ((problem, minimum), (other, found)))
    np.testing.assert_allclose(a, b, atol=1e-8)
    np.testing.assert_allclose(
        found.values["camera"], minimum.values["camera"], rtol=SAME, atol=1e-12
    )
    np.testing.assert_allclose(
        camera_sigmas(other, found.values), camera_sigmas(problem, minimum.values), rtol=1e-7
    )
    # Inner constraints against the moved start values are the moved inner constraints.
    point = np.asarray(minimum.values["point"]) + problem.origin
    np.testing.assert_allclose(
        np.asarray(found.values["point"]) + other.origin, move(point), atol=SCALE * SAME
    )


def shifted(network, shift):
    images, points = network.images, network.points
    return network.replace(
        images=dataclasses.replace(images, position=images.position + shift),
        points=dataclasses.replace(points, position=points.position + shift),
    )


def test_a_national_grid_loses_nothing():
    # First rounded to the spacing of floats at 5e6, so that both networks are the same exactly.
    shift = np.array([5e6, 4.1e5, 100.0])
    far = shifted(synthetic(**NETWORKS[SHARED])[0], shift)
    near = shifted(far, -shift)
    problems = [make_problem(network) for network in (near, far)]
    minima = [solved(problem) for problem in problems]
    apart = problems[1].origin - problems[0].origin - shift
    for a, b in ((m.values["point"] for m in minima), (m.values["image"].position for m in minima)):
        # 1e-12 of the object's size: rounding of a network of this size, not of the grid.
        np.testing.assert_allclose(np.asarray(b) + apart, a, atol=1e-12)
    cameras = [p.interior_orientation(m.values) for p, m in zip(problems, minima)]
    np.testing.assert_allclose(*cameras, rtol=1e-10)
    costs = [vtpv(p, m.values) for p, m in zip(problems, minima)]
    assert costs[0] == pytest.approx(costs[1], rel=1e-11)
