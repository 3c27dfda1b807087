"""Normal blocks and steps against dense matrices of residuals ∘ retract. (The exact Hessian:
tests/leastsquares/test_derivatives.py.)"""

from functools import cache

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from adjustment_checks import (
    DEFECTS,
    LINEARISED,
    bordered_inverse,
    flat,
    linearised,
    make,
)

from jaxbundle.geometry import matrix_from_omega_phi_kappa, quaternion_from_matrix
from jaxbundle.leastsquares.equations.elimination import damp, factorise, solve
from jaxbundle.leastsquares.equations.normal import Normal, normal_equations
from jaxbundle.leastsquares.indexing.rows import lay_out_data
from jaxbundle.leastsquares.problem import pad_data
from jaxbundle.leastsquares.spaces import Pose, PoseValue
from jaxbundle.network.kinds.exterior_orientation import EXTERIOR_ORIENTATION as EXTERIOR

DAMPING = 1e-2


@cache
def blocks_of(name):
    """Of the engine, at the start values: gradient, N, the damped N, a damped and an undamped
    step."""
    system = make(name)
    return _blocks(system.declared, system.plan, pad_data(system, system.data))


@eqx.filter_jit
def _blocks(declared, plan, data):
    laid = lay_out_data(plan, data)
    _, gradient, blocks = normal_equations(declared, plan, data.start, laid)
    normal = Normal(plan, blocks)
    damped = damp(normal, DAMPING)
    steps = solve(factorise(damped, False), gradient), solve(factorise(normal), gradient)
    return gradient, normal.as_matrix(), damped.as_matrix(), *steps


def assert_same(found, dense, size, tolerance):
    """Matrices or steps agree in units of the scaled unknowns, whose N has a unit diagonal."""
    size = np.where(size > 0, size, 1.0)
    if np.ndim(dense) == 2:
        size = size[:, None] * size
        found, dense = found / size, dense / size
    else:
        found, dense = found * size, dense * size
    assert np.abs(found - dense).max() <= tolerance * np.abs(dense).max()


@pytest.mark.parametrize("name", LINEARISED)
def test_blocks_are_those_of_the_dense_product(name):
    dense, counts = linearised(name), make(name).counts
    gradient, N, *_ = blocks_of(name)
    size = np.linalg.norm(dense.J, axis=0)
    assert ((size > 0) == dense.free).all() and dense.free.sum() == counts.unknowns
    rows = counts.observations
    assert (np.linalg.norm(dense.J, axis=1) > 0).sum() == rows
    assert_same(np.asarray(N), dense.N, size, 1e-13)
    terms = size * np.linalg.norm(dense.v)
    assert (np.abs(flat(gradient) - dense.J.T @ dense.v) <= 1e-12 * terms).all()


@pytest.mark.parametrize("name", LINEARISED)
def test_damped_step(name):
    """Compared with the damped matrix, which adds a positive definite part everywhere."""
    dense = linearised(name)
    gradient, N, damped, step, _ = blocks_of(name)
    free, size = dense.free, np.linalg.norm(dense.J, axis=0)
    more = np.asarray(damped - N)[np.ix_(free, free)] / DAMPING
    scaled = more / size[free] / size[free][:, None]
    assert np.linalg.eigvalsh(scaled).min() > 1e-4 and np.linalg.eigvalsh(scaled).max() < 1e3
    expected = np.zeros(len(free))
    g = dense.J.T @ dense.v
    expected[free] = np.linalg.solve(dense.N[np.ix_(free, free)] + DAMPING * more, g[free])
    assert_same(flat(step), expected, size, 1e-9)


@pytest.mark.parametrize("name", LINEARISED)
def test_undamped_step(name):
    """That of a free network may differ from the dense one along G only."""
    dense, size = linearised(name), np.linalg.norm(linearised(name).J, axis=0)
    assert dense.G.shape[1] == DEFECTS.get(name, 0)
    along = np.linalg.norm(dense.J) * np.linalg.norm(dense.G, axis=0)
    assert (np.linalg.norm(dense.J @ dense.G, axis=0) < 1e-12 * along).all()
    expected = bordered_inverse(dense.N, dense.G, dense.free) @ (dense.J.T @ dense.v)
    step = flat(blocks_of(name)[-1])
    along = np.linalg.lstsq(dense.G, step - expected, rcond=None)[0]
    assert_same(step - dense.G @ along, expected, size, 1e-9)


def test_a_prior_of_angles_counts_from_the_representation_it_is_given_in():
    # φ beyond 90°: (ω, φ, κ) and (ω + π, π − φ, κ + π) are one rotation.
    given = jnp.asarray([1.0, 2.0, 3.0, 0.2, 1.9, -0.4])

    def misclosure(angles):
        q = quaternion_from_matrix(matrix_from_omega_phi_kappa(angles))
        return EXTERIOR.residual(Pose().prepare(PoseValue(given[:3], q)), given)

    np.testing.assert_allclose(misclosure(given[3:]), 0, atol=1e-12)
    # One degree in ω is one degree of residual.
    turned = given[3:].at[0].add(jnp.pi / 180)
    np.testing.assert_allclose(misclosure(turned), [0, 0, 0, np.pi / 180, 0, 0], atol=1e-12)
