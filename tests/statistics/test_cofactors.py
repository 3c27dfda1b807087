"""Cofactors and reliability from blocks, against the dense inverse with the datum conditions."""

import dataclasses
from functools import cache

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from adjustment_checks import (
    LINEARISED,
    NETWORKS,
    bordered_inverse,
    datum_matrices,
    flat,
    linearised,
    solved,
    synthetic,
)

from jaxbundle.adjustment.jacobian import compiled_jacobian, free_tangent
from jaxbundle.adjustment.problem import make_problem
from jaxbundle.adjustment.residuals import residuals
from jaxbundle.adjustment.solve import find_minimum, make_solver
from jaxbundle.adjustment.solver import SETTLED
from jaxbundle.geometry import quaternion_difference
from jaxbundle.network.arrays import Tangent
from jaxbundle.statistics.cofactors import cofactors, propagate, undamped_factor
from jaxbundle.statistics.reliability import (
    external_reliability,
    hat_diagonal,
    minimal_detectable,
    reliability,
)


@cache
def both(name):
    """The cofactors in blocks and dense, and the hat matrix's diagonal from blocks."""
    net = linearised(name)
    s, values = net.problem.structure, net.problem.data.start
    factor = undamped_factor(s, values, net.problem.data)
    blocks = cofactors(s, values, factor)
    hat = eqx.filter_jit(hat_diagonal)(net.jac, blocks)
    _, B = datum_matrices(s, values)
    return net, factor, blocks, bordered_inverse(net.N, B, flat(free_tangent(s))), hat


def standard_deviations(Q):
    """0 for what is held, in a minimal datum up to rounding of either sign."""
    variance = np.diag(Q)
    return np.sqrt(np.where(variance > 1e-14 * variance.max(), variance, 0))


def assert_close(found, dense, sigma_rows, sigma_columns, tolerance=1e-8):
    """In units of the standard deviations of rows and columns."""
    size = np.outer(sigma_rows, sigma_columns)
    size = np.where(size > 0, size, 1)
    assert (np.abs(found - dense) / size).max() < tolerance


@pytest.mark.parametrize("name", LINEARISED)
def test_blocks(name):
    net, _, blocks, Q, _ = both(name)
    s = net.problem.structure
    first = s.images * s.image_width + s.cameras * s.camera_width
    at_point = lambda p: first + 3 * p + np.arange(3)
    sigma = standard_deviations(Q)
    blocks_at = [
        *((blocks.image[i], i * s.image_width + np.arange(s.image_width)) for i in range(s.images)),
        *((blocks.point[p], at_point(p)) for p in range(s.points)),
    ]
    if s.camera_width:
        at_camera = s.images * s.image_width + np.arange(s.camera_width)
        blocks_at += [
            (blocks.camera[c], at_camera + c * s.camera_width) for c in range(s.cameras)
        ]
    for block, rows in blocks_at:
        assert_close(block, Q[np.ix_(rows, rows)], sigma[rows], sigma[rows])


@pytest.mark.parametrize("name", LINEARISED)
def test_propagation_to_any_function(name):
    net, factor, _, Q, _ = both(name)
    s, values = net.problem.structure, net.problem.data.start
    rng = np.random.default_rng(4)
    sigma = standard_deviations(Q)
    F = rng.normal(size=(5, len(Q))) * np.where(sigma > 0, 1 / np.where(sigma > 0, sigma, 1), 0)
    F[:3, : s.images * s.image_width] = 0  # some of points and cameras alone
    unravel = jax.flatten_util.ravel_pytree(free_tangent(s))[1]
    rows = jax.vmap(unravel)(jnp.asarray(F))
    found = propagate(s, values, factor, rows)
    dense = F @ Q @ F.T
    sigma = standard_deviations(dense)
    assert_close(found, dense, sigma, sigma)


@pytest.mark.parametrize("name", LINEARISED)
def test_redundancy_numbers(name):
    net, _, _, Q, hat = both(name)
    dense = ((net.J @ Q) * net.J).sum(1)
    np.testing.assert_allclose(flat(hat), dense, atol=1e-9)
    counts = net.problem.counts
    rows = counts.observations + counts.pseudo_observations
    assert rows - flat(hat).sum() == pytest.approx(counts.redundancy, abs=1e-9)


def test_points_measured_twice_in_an_image():
    network, _ = synthetic(**NETWORKS["free"])
    rows = np.concatenate([np.arange(len(network.observations)), [3, 3, 20]])
    problem = make_problem(network.replace(observations=network.observations.take(rows)))
    s, data = problem.structure, problem.data
    jac = compiled_jacobian(s, data.start, data)
    J = np.asarray(jac.as_matrix())
    Q = bordered_inverse(J.T @ J, datum_matrices(s, data.start)[1], np.ones(len(J.T)))
    blocks = cofactors(s, data.start, undamped_factor(s, data.start, data))
    hat = flat(eqx.filter_jit(hat_diagonal)(jac, blocks))
    np.testing.assert_allclose(hat, ((J @ Q) * J).sum(1), atol=1e-9)
    sigma = standard_deviations(Q)
    for i in range(s.images):
        rows = i * s.image_width + np.arange(s.image_width)
        assert_close(blocks.image[i], Q[np.ix_(rows, rows)], sigma[rows], sigma[rows])


@pytest.mark.parametrize("name", ["shared cameras of two models", "own cameras of two models"])
def test_reliability(name):
    net, _, blocks, Q, _ = both(name)
    s, data = net.problem.structure, net.problem.data
    found = reliability(s, data.start, data, blocks)
    r, v, w = flat(found.redundancy), flat(found.residual), flat(found.w)
    np.testing.assert_allclose(v, flat(net.rows), rtol=1e-12, atol=1e-12)
    assert r.sum() == pytest.approx(net.problem.counts.redundancy, abs=1e-9)
    controlled = r > 1e-8
    np.testing.assert_allclose(w[controlled], v[controlled] / np.sqrt(r[controlled]))
    assert np.isnan(w[~controlled]).all()
    # A blunder of the smallest size moves its own w by δ0, and no unknown by more than δ̄·σ.
    row, delta0 = int(np.argmax(r)), 4.13
    blunder = float(minimal_detectable(1.0, r[row], delta0))
    change = -Q @ net.J.T[:, row] * blunder
    residual = net.J[row] @ change + blunder
    assert residual / np.sqrt(r[row]) == pytest.approx(delta0, rel=1e-8)
    effect = float(external_reliability(r[row], delta0))
    assert np.sqrt(change @ net.N @ change) == pytest.approx(effect, rel=1e-7)
    sigma = standard_deviations(Q)
    assert (np.abs(change) / np.where(sigma > 0, sigma, np.inf)).max() <= effect * (1 + 1e-9)


def test_what_is_not_controlled_has_no_finite_bound():
    assert np.isinf(minimal_detectable(0.01, jnp.asarray(0.0)))
    assert np.isinf(external_reliability(jnp.asarray(1e-12)))


DRAWS = 300


def assert_between(value, expected, standard_deviation, times=4.0):
    assert abs(value - expected) < times * standard_deviation, (value, expected)


@pytest.mark.slow
def test_predicted_uncertainty_is_that_of_a_sample():
    """300 adjustments of a free self-calibrating network with fresh noise.

    A third of σ: error propagation is of first order, and this weak network is curved (with noise
    of σ its Gauss–Newton steps may shrink by a half only).
    """
    part = 1 / 3
    problem = make_problem(synthetic(datum="inner", noise=0.0)[0])
    s, data = problem.structure, problem.data
    rng = np.random.default_rng(12)
    noise = rng.normal(size=(DRAWS, *data.image_xy.shape)) / np.asarray(data.image_weight)
    solver = make_solver(problem, max_steps=100)

    @eqx.filter_jit
    def sample(xy):
        def one(xy):
            drawn = dataclasses.replace(data, image_xy=xy)
            minimum = find_minimum(solver, drawn)
            rows = residuals(s, minimum.values, drawn)
            return minimum.termination, minimum.values, jnp.sum(rows.image**2) / part**2

        return jax.vmap(one)(xy)

    termination, values, vtpv = sample(data.image_xy + part * noise)
    assert (np.asarray(termination) == SETTLED).all()
    true = solved(problem).values

    turn = jax.vmap(jax.vmap(quaternion_difference), (0, None))(values.rotation, true.rotation)
    exterior = jnp.concatenate([values.position - true.position, turn], 2)
    camera = (values.camera - true.camera)[:, :, np.asarray(s.camera_columns[0])]
    change = Tangent(exterior, camera, values.point - true.point)
    x = [np.asarray(block).reshape(DRAWS, -1) / part for block in jax.tree.leaves(change)]
    x = np.concatenate(x, 1)

    identity = jax.vmap(jax.flatten_util.ravel_pytree(free_tangent(s))[1])(jnp.eye(x.shape[1]))
    Q = np.asarray(propagate(s, true, undamped_factor(s, true, data), identity))
    sigma = np.sqrt(np.diag(Q))
    # Every σ: 67 of them, each with a relative error of 1/√(2·300) = 4.1 %.
    ratio = np.sqrt((x**2).mean(0)) / sigma
    assert np.abs(ratio - 1).max() < 4.5 / np.sqrt(2 * DRAWS)
    assert_between(ratio.mean(), 1, 1 / np.sqrt(2 * DRAWS))
    # No bias beyond sampling, and no correlation wrong: χ² of the camera's four parameters.
    # (Not of all unknowns: what is known 1000 times better shows the curvature of the rest.)
    mean = x.mean(0) / sigma * np.sqrt(DRAWS)
    assert np.abs(mean).max() < 4.5
    at = slice(s.images * 6, s.images * 6 + 4)
    weight = np.linalg.inv(Q[at, at])
    square = np.einsum("di,ij,dj->d", x[:, at], weight, x[:, at])
    assert_between(square.mean(), 4, np.sqrt(2 * 4 / DRAWS))
    assert_between(mean[at] * sigma[at] @ weight @ (mean[at] * sigma[at]), 4, np.sqrt(2 * 4))
    # vᵀPv is χ² of the redundancy.
    f = problem.counts.redundancy
    assert_between(np.mean(vtpv), f, np.sqrt(2 * f / DRAWS))
    assert_between(np.var(vtpv) / (2 * f), 1, np.sqrt((2 + 12 / f) / DRAWS), times=4.5)
