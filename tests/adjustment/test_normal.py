"""Normal blocks, exact Hessian and the Schur step against dense matrices of the same network."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from adjustment_checks import (
    DEFECTS,
    LINEARISED,
    assert_columns_agree,
    bordered_inverse,
    columns,
    dense_normal,
    differences,
    flat,
    gradients_of_changes,
    linearised,
    of_change,
)

from jaxbundle.adjustment.jacobian import free_tangent
from jaxbundle.adjustment.normal import diagonal
from jaxbundle.adjustment.schur import factorise, solve

WELL_POSED = [name for name in LINEARISED if name not in DEFECTS]
FREE_NETWORKS = [name for name in LINEARISED if name in DEFECTS]


@eqx.filter_jit
def damped_step(structure, normal, damping, right):
    return solve(factorise(structure, normal, damping, regular=False), right)


@eqx.filter_jit
def undamped_step(structure, normal, right):
    return solve(factorise(structure, normal), right)


def assert_same_step(step, dense, N, tolerance):
    """Compared in units of the scaled unknowns, δ·√N_ii."""
    scale = np.sqrt(np.maximum(np.diag(N), 0.0))
    difference = np.abs((flat(step) - dense) * scale).max()
    assert difference <= tolerance * np.abs(dense * scale).max()


@pytest.mark.parametrize("name", LINEARISED)
def test_blocks_are_those_of_the_dense_product(name):
    net = linearised(name)
    N = dense_normal(net.problem.structure, net.normal)
    size = np.sqrt(np.diag(net.N))
    np.testing.assert_array_less(np.abs(N - net.N), 1e-13 * np.outer(size, size) + 1e-300)
    expected = np.where(np.diag(net.N) > 0, np.diag(net.N), 1.0)
    np.testing.assert_allclose(flat(diagonal(net.normal)), expected)


@pytest.mark.parametrize("name", LINEARISED)
@pytest.mark.parametrize("matrix, damping", [("normal", 1e-2), ("normal", 1e3), ("curved", 10)])
def test_damped_step(name, matrix, damping):
    net = linearised(name)
    structure, blocks = net.problem.structure, getattr(net, matrix)
    D = jax.tree.map(lambda d: damping * d, diagonal(net.normal))
    step = damped_step(structure, blocks, D, net.gradient)
    free = np.flatnonzero(flat(free_tangent(structure)))
    scale = 1 / np.sqrt(np.diag(net.N)[free])
    A = dense_normal(structure, blocks)[np.ix_(free, free)]
    A = A * scale[:, None] * scale + damping * np.eye(len(free))
    dense = np.zeros(len(net.N))
    dense[free] = scale * np.linalg.solve(A, scale * flat(net.gradient)[free])
    assert_same_step(step, dense, net.N, 1e-9)


@pytest.mark.parametrize("name", WELL_POSED)
def test_undamped_step(name):
    net = linearised(name)
    structure = net.problem.structure
    no_conditions = np.zeros((len(net.N), 0))
    dense = bordered_inverse(net.N, no_conditions, flat(free_tangent(structure)))
    step = undamped_step(structure, net.normal, net.gradient)
    assert_same_step(step, dense @ flat(net.gradient), net.N, 1e-9)


@pytest.mark.parametrize("name", FREE_NETWORKS)
def test_undamped_step_of_a_free_network(name):
    # The regularised step may differ from the dense one along G only, N·δ = g must hold.
    net = linearised(name)
    G = columns(net.gauge)
    assert G.shape[1] == DEFECTS[name]
    size = np.linalg.norm(net.J) * np.linalg.norm(G, axis=0)
    assert (np.linalg.norm(net.J @ G, axis=0) < 1e-12 * size).all()
    dense = bordered_inverse(net.N, G, np.ones(len(net.N))) @ flat(net.gradient)
    step = flat(undamped_step(net.problem.structure, net.normal, net.gradient))
    along = np.linalg.lstsq(G, step - dense, rcond=None)[0]
    assert_same_step(step - G @ along, dense, net.N, 1e-9)


@pytest.mark.parametrize("name", LINEARISED)
def test_exact_hessian(name):
    net = linearised(name)
    structure, data = net.problem.structure, net.problem.data
    H = dense_normal(structure, net.curved)
    other = differences(gradients_of_changes, structure, data.start, data, net.J)
    size = np.sqrt(np.maximum(np.diag(net.N), 1e-300))
    curvature = np.abs(H - net.N) / np.outer(size, size)
    difference = np.abs(H - other) / np.outer(size, size)
    # The residuals of the start values make the curvature visible, far above the differences.
    assert curvature.max() > 1e-3
    assert difference.max() < 1e-7


@pytest.mark.slow
def test_exact_hessian_by_second_derivatives_of_everything():
    net = linearised("held images, exterior priors")
    structure, data = net.problem.structure, net.problem.data
    function, zero = of_change(structure, data.start, data)
    dense = jax.jit(jax.hessian(lambda change: 0.5 * jnp.sum(function(change) ** 2)))(zero)
    assert_columns_agree(dense_normal(structure, net.curved), np.asarray(dense), 1e-11)
