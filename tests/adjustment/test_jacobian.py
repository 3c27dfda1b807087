"""The Jacobian in blocks against central differences of residuals ∘ retract."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from adjustment_checks import (
    CAMERAS,
    LINEARISED,
    assert_columns_agree,
    camera,
    differences,
    flat,
    free_parameters,
    linearised,
    of_change,
    residuals_of_changes,
    synthetic,
)

from jaxbundle.adjustment.jacobian import free_tangent, jacobian
from jaxbundle.adjustment.residuals import exterior_residual
from jaxbundle.cameras import MODEL_NAMES
from jaxbundle.geometry import matrix_from_omega_phi_kappa, quaternion_from_matrix
from jaxbundle.network import make_structure

DIFFERENCES = 1e-7
"""Of a column's norm; see `adjustment_checks.differences`."""


def free_sets(model):
    """None, the principal distance, all, the first and the last."""
    names = free_parameters(model)
    return (), names[:1], names, (names[0], names[-1])


def network_of(cameras, domain):
    """Two images a camera, four points."""
    of_image = np.repeat(np.arange(len(cameras)), 2)
    network, _ = synthetic(
        cameras=cameras, of_image=of_image, images=len(of_image), points=4, domain=domain
    )
    return make_structure(network)[:2]


def assert_matches_differences(structure, data):
    J = np.asarray(block_jacobian(structure, data.start, data))
    free = flat(free_tangent(structure))
    assert (J[:, free == 0] == 0).all()
    assert (np.linalg.norm(J[:, free > 0], axis=0) > 0).all()
    other = differences(residuals_of_changes, structure, data.start, data, J)
    assert_columns_agree(J, other, DIFFERENCES)


@eqx.filter_jit
def block_jacobian(structure, values, data):
    return jacobian(structure, values, data).as_matrix()


@pytest.mark.slow
@pytest.mark.parametrize("domain", ["corrected", "measured"])
def test_every_model_with_every_free_set(domain):
    assert set(CAMERAS) == set(MODEL_NAMES)
    cameras = [
        camera(f"{name} {i}", name, free)
        for name in MODEL_NAMES
        for i, free in enumerate(free_sets(name))
    ]
    assert_matches_differences(*network_of(cameras, domain))


@pytest.mark.parametrize("name", LINEARISED)
def test_every_kind_of_network(name):
    net = linearised(name)
    structure, data = net.problem.structure, net.problem.data
    other = differences(residuals_of_changes, structure, data.start, data, net.J)
    assert_columns_agree(net.J, other, DIFFERENCES)
    counts = net.problem.counts
    rows = (np.linalg.norm(net.J, axis=1) > 0).sum()
    assert rows == counts.observations + counts.pseudo_observations
    assert (np.linalg.norm(net.J, axis=0) > 0).sum() == counts.unknowns


@pytest.mark.parametrize("name", LINEARISED)
def test_products_agree_with_the_matrix(name):
    net = linearised(name)
    rng = np.random.default_rng(1)
    vector = jax.tree.map(lambda g: jnp.asarray(rng.normal(size=g.shape)), net.gradient)
    rows = jax.tree.map(lambda r: jnp.asarray(rng.normal(size=r.shape)), net.rows)
    product, transposed = net.jac.mv(vector), net.jac.transposed_mv(rows)
    scale = np.linalg.norm(net.J, axis=0).max()
    np.testing.assert_allclose(flat(product), net.J @ flat(vector), atol=1e-12 * scale)
    np.testing.assert_allclose(flat(transposed), net.J.T @ flat(rows), atol=1e-12 * scale)
    np.testing.assert_allclose(flat(product) @ flat(rows), flat(vector) @ flat(transposed))
    np.testing.assert_allclose(
        flat(net.gradient), net.J.T @ flat(net.rows), atol=1e-12 * scale * flat(net.rows).max()
    )
    assert (net.jac.out_size(), net.jac.in_size()) == net.J.shape


def test_forward_mode_through_everything_gives_the_same_digits():
    net = linearised("own cameras of two models")
    problem = net.problem
    function, zero = of_change(problem.structure, problem.data.start, problem.data)
    # The same derivatives in another order of operations: rounding only.
    assert_columns_agree(net.J, np.asarray(jax.jit(jax.jacfwd(function))(zero)), 1e-11)


def test_a_prior_of_angles_counts_from_the_representation_it_is_given_in():
    # φ beyond 90°: (ω, φ, κ) and (ω + π, π − φ, κ + π) are one rotation.
    given = jnp.asarray([1.0, 2.0, 3.0, 0.2, 1.9, -0.4])
    q = quaternion_from_matrix(matrix_from_omega_phi_kappa(given[3:]))
    still = exterior_residual(given[:3], q, given, jnp.ones(6), jnp.zeros(6))
    np.testing.assert_allclose(still, 0, atol=1e-12)
    # One degree in ω is one degree of residual.
    turned = given.at[3].add(jnp.pi / 180)
    q = quaternion_from_matrix(matrix_from_omega_phi_kappa(turned[3:]))
    moved = exterior_residual(given[:3], q, given, jnp.ones(6), jnp.zeros(6))
    np.testing.assert_allclose(moved, [0, 0, 0, np.pi / 180, 0, 0], atol=1e-12)
