"""The minimum: reached from afar, the same by both methods, in any unit and at any place."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from adjustment_checks import (
    LINEARISED,
    NETWORKS,
    adjusted,
    flat,
    solved,
    synthetic,
    vtpv,
)

from jaxbundle.adjustment.jacobian import compiled_jacobian
from jaxbundle.adjustment.problem import make_problem
from jaxbundle.adjustment.residuals import compiled_residuals
from jaxbundle.adjustment.solve import make_solver
from jaxbundle.adjustment.solver import SETTLED
from jaxbundle.geometry import (
    matrix_from_omega_phi_kappa,
    matrix_from_quaternion,
    matrix_from_rotation_vector,
    omega_phi_kappa_from_matrix,
)
from jaxbundle.statistics.cofactors import cofactors, undamped_factor

SLOW = ("held images, exterior priors", "free with distances", "own cameras of two models")

SAME = 1e-8
"""Two runs to the same minimum differ by rounding of vᵀPv, √1e-15 of σ at most."""


def camera_sigmas(problem, values):
    """A priori σ of the parameters of the shared cameras."""
    s = problem.structure
    factor = undamped_factor(s, values, problem.data)
    Q = np.asarray(cofactors(s, values, factor).camera)
    return np.sqrt(np.diagonal(Q, axis1=1, axis2=2))


def rotations(values):
    return np.asarray(jax.vmap(matrix_from_quaternion)(values.rotation))


def assert_same_values(a, b, tolerance=SAME):
    """Agreement of two solutions; tolerances in m, radians, and units of the parameters."""
    np.testing.assert_allclose(a.point, b.point, atol=tolerance * 1e-2)
    np.testing.assert_allclose(a.position, b.position, atol=tolerance * 1e-1)
    np.testing.assert_allclose(rotations(a), rotations(b), atol=tolerance * 1e-1)
    np.testing.assert_allclose(a.camera, b.camera, atol=tolerance, rtol=tolerance)


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=pytest.mark.slow) if name in SLOW else name
        for name in LINEARISED
    ],
)
def test_the_minimum_is_one(name):
    problem, minimum = adjusted(name)
    assert int(minimum.termination) == SETTLED
    jac = compiled_jacobian(problem.structure, minimum.values, problem.data)
    rows = compiled_residuals(problem.structure, minimum.values, problem.data)
    # The gradient in scaled unknowns, against the size of what cancels in it.
    terms = np.sqrt((flat(rows) ** 2).sum())
    J = np.asarray(jac.as_matrix())
    size = np.linalg.norm(J, axis=0)
    gradient = (J.T @ flat(rows)) / np.where(size > 0, size, 1)
    assert np.abs(gradient).max() < 1e-9 * terms
    # σ0 of simulated noise: 1 within four times its standard deviation.
    redundancy = problem.counts.redundancy
    sigma0 = np.sqrt(vtpv(problem, minimum.values) / redundancy)
    assert abs(sigma0 - 1) < 4 / np.sqrt(2 * redundancy)
    cost = np.asarray(minimum.history.cost)[: int(minimum.iterations)]
    taken = cost[np.asarray(minimum.history.accepted)[: int(minimum.iterations)]]
    assert (np.diff(taken) < 1e-12 * taken[1:]).all()


@pytest.mark.parametrize("name", ["shared cameras of two models", "own cameras of two models"])
def test_from_start_values_ten_times_as_bad(name):
    problem, minimum = adjusted(name)
    network, _ = synthetic(**NETWORKS[name], disturbance=10)
    worse = make_problem(network)
    assert np.abs(worse.data.start.point - problem.data.start.point).max() > 0.1
    other = solved(worse)
    assert int(other.termination) == SETTLED
    assert_same_values(other.values, minimum.values)


def test_a_free_network_from_other_start_values():
    # Its datum is another one, so only what does not depend on it can be compared.
    problem, minimum = adjusted("free")
    other = make_problem(synthetic(**NETWORKS["free"], disturbance=5)[0])
    found = solved(other)
    assert int(found.termination) == SETTLED
    np.testing.assert_allclose(found.values.camera, minimum.values.camera, rtol=SAME, atol=1e-11)
    rows = [
        flat(compiled_residuals(p.structure, m.values, p.data))
        for p, m in ((problem, minimum), (other, found))
    ]
    np.testing.assert_allclose(rows[0], rows[1], atol=1e-7)


def test_all_free_datums_have_the_same_residuals():
    rows = []
    for name in ("free", "minimal"):
        problem, minimum = adjusted(name)
        rows.append(flat(compiled_residuals(problem.structure, minimum.values, problem.data)))
    np.testing.assert_allclose(rows[0], rows[1], atol=1e-8)


def test_gauss_newton_finds_the_same():
    problem, minimum = adjusted("shared cameras of two models")
    other = solved(problem, method="gauss-newton")
    assert int(other.termination) == SETTLED
    assert_same_values(other.values, minimum.values)
    assert (np.asarray(other.history.damping)[1 : int(other.iterations)] == 0).all()


def test_methods_are_named():
    with pytest.raises(ValueError, match="levenberg-marquardt, gauss-newton, not 'newton'"):
        make_solver(adjusted("free")[0], "newton")


@pytest.mark.parametrize("name", ["shared cameras of two models", "free"])
def test_exact_data_give_back_the_truth(name):
    network, truth = synthetic(**NETWORKS[name], noise=0.0)
    problem = make_problem(network)
    minimum = solved(problem)
    assert int(minimum.termination) == SETTLED
    assert vtpv(problem, minimum.values) < 1e-14
    if name != "free":
        np.testing.assert_allclose(minimum.values.point + problem.origin, truth.point, atol=1e-10)
        np.testing.assert_allclose(rotations(minimum.values), truth.matrix, atol=1e-10)
    free = np.asarray(problem.structure.camera_columns)
    for c, camera in enumerate(problem.network.cameras):
        given = np.array(list(camera.parameters.values()))
        found = np.asarray(minimum.values.camera)[c, free[c]]
        np.testing.assert_allclose(found, given[free[c]], rtol=1e-8)


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
    a, b = (
        flat(compiled_residuals(p.structure, m.values, p.data))
        for p, m in ((problem, minimum), (other, found))
    )
    np.testing.assert_allclose(a, b, atol=1e-8)
    np.testing.assert_allclose(found.values.camera, minimum.values.camera, rtol=SAME, atol=1e-12)
    np.testing.assert_allclose(
        camera_sigmas(other, found.values), camera_sigmas(problem, minimum.values), rtol=1e-7
    )
    # Inner constraints against the moved start values are the moved inner constraints.
    point = np.asarray(minimum.values.point) + problem.origin
    np.testing.assert_allclose(
        np.asarray(found.values.point) + other.origin, move(point), atol=SCALE * SAME
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
    far = shifted(synthetic(**NETWORKS["shared cameras of two models"])[0], shift)
    near = shifted(far, -shift)
    problems = [make_problem(network) for network in (near, far)]
    minima = [solved(problem) for problem in problems]
    apart = problems[1].origin - problems[0].origin - shift
    for a, b in ((m.values.point for m in minima), (m.values.position for m in minima)):
        # 1e-12 of the object's size: rounding of a network of this size, not of the grid.
        np.testing.assert_allclose(np.asarray(b) + apart, a, atol=1e-12)
    np.testing.assert_allclose(minima[0].values.camera, minima[1].values.camera, rtol=1e-10)
    costs = [vtpv(p, m.values) for p, m in zip(problems, minima)]
    assert costs[0] == pytest.approx(costs[1], rel=1e-11)
