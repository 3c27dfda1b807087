"""Cofactors and reliability from blocks, against the dense inverse with the datum conditions."""

from functools import cache

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from adjustment_checks import (
    linearise,
    linearised,
    make,
    solved,
    standard_deviations,
    synthetic,
)

from jaxbundle.adjustment.problem import make_problem
from jaxbundle.adjustment.quality.inspection import Inspection
from jaxbundle.adjustment.quality.projection_uncertainty import images_through_scene
from jaxbundle.cameras import get_model
from jaxbundle.geometry import quaternion_difference
from jaxbundle.leastsquares.datum.conditions import move_to_datum
from jaxbundle.leastsquares.iterations.solver import minimise
from jaxbundle.leastsquares.iterations.stopping import SETTLED
from jaxbundle.leastsquares.problem import make_solver, pad_data
from jaxbundle.leastsquares.quality.reliability import external_reliability, minimal_detectable
from jaxbundle.leastsquares.spaces import PoseValue

NAMES = ("cameras of two models", "everything given", "free", "minimal")


@cache
def both(name):
    """The start values inspected in blocks, and dense with the cofactors of all unknowns."""
    dense = linearised(name)
    return Inspection(make(name), make(name).data.start), dense, dense.Q


def assert_close(found, dense, sigma_rows, sigma_columns, tolerance=1e-8):
    """In units of the standard deviations of rows and columns."""
    size = np.outer(sigma_rows, sigma_columns)
    size = np.where(size > 0, size, 1)
    assert (np.abs(found - dense) / size).max() < tolerance


@pytest.mark.parametrize("name", NAMES)
def test_blocks(name):
    found, dense, Q = both(name)
    sigma = standard_deviations(Q)
    for table in found.problem.tables:
        for block, rows in zip(found.solution.cofactor(table.name), dense.columns[table.name]):
            assert_close(block, Q[np.ix_(rows, rows)], sigma[rows], sigma[rows])


@pytest.mark.parametrize("name", ["everything given", "free"])
def test_propagation_to_any_function(name):
    found, dense, Q = both(name)
    random, tables, F = np.random.default_rng(4), {}, np.zeros((5, len(Q)))
    sigma = standard_deviations(Q)
    for table, columns in dense.columns.items():
        size = np.where(sigma > 0, 1 / np.where(sigma > 0, sigma, 1), 0)[columns]
        tables[table] = random.normal(size=(5, *columns.shape)) * size
        if table == "image":
            tables[table][:3] = 0  # some of points and cameras alone
        np.add.at(F, (slice(None), columns.ravel()), tables[table].reshape(5, -1))
    expected = F @ Q @ F.T
    sigma = standard_deviations(expected)
    assert_close(found.solution.propagate_rows(tables), expected, sigma, sigma)


@pytest.mark.parametrize("name", ["everything given", "free"])
def test_joint_cofactors_of_some_rows(name):
    found, dense, Q = both(name)
    sigma = standard_deviations(Q)
    for table, rows in (("point", [3, 0, 4]), ("image", [1, 0])):
        columns = dense.columns[table][rows]
        joint = found.solution.joint_cofactors(table, rows)
        assert joint.shape == columns.shape * 2
        columns = columns.ravel()
        assert_close(
            joint.reshape(len(columns), -1), Q[np.ix_(columns, columns)], sigma[columns],
            sigma[columns],
        )  # fmt: skip


@pytest.mark.parametrize("name", NAMES)
def test_redundancy_numbers(name):
    found, dense, Q = both(name)
    r = np.concatenate([r.ravel() for r in found.solution.reliability.redundancy.values()])
    used = np.concatenate([(w > 0).ravel() for w in weights(found.problem)])
    hat = ((dense.J @ Q) * dense.J).sum(1)
    np.testing.assert_allclose(r, np.where(used, 1 - hat, 0), atol=1e-9)
    assert r.sum() == pytest.approx(found.problem.counts.redundancy, abs=1e-9)


def weights(problem):
    return [problem.weights(o.name) for o in problem.observations]


def test_reliability():
    found, dense, Q = both("cameras of two models")
    tested = found.solution.reliability
    r, v, w = (
        np.concatenate([rows.ravel() for rows in of.values()])
        for of in (tested.redundancy, tested.residual, tested.w)
    )
    np.testing.assert_allclose(v, dense.v, rtol=1e-12, atol=1e-12)
    controlled = r > 1e-8
    np.testing.assert_allclose(w[controlled], v[controlled] / np.sqrt(r[controlled]))
    assert np.isnan(w[~controlled]).all()
    # A blunder of the smallest size moves its own w by δ0, and no unknown by more than δ̄·σ.
    row, delta0 = int(np.argmax(r)), 4.13
    blunder = float(minimal_detectable(1.0, r[row], delta0))
    change = -Q @ dense.J.T[:, row] * blunder
    residual = dense.J[row] @ change + blunder
    assert residual / np.sqrt(r[row]) == pytest.approx(delta0, rel=1e-8)
    effect = float(external_reliability(r[row], delta0))
    assert np.sqrt(change @ dense.N @ change) == pytest.approx(effect, rel=1e-7)
    sigma = standard_deviations(Q)
    assert (np.abs(change) / np.where(sigma > 0, sigma, np.inf)).max() <= effect * (1 + 1e-9)


def test_what_is_not_controlled_has_no_finite_bound():
    assert np.isinf(minimal_detectable(0.01, jnp.asarray(0.0)))
    assert np.isinf(external_reliability(jnp.asarray(1e-12)))


DRAWS = 300


def assert_between(value, expected, standard_deviation, times=4.0):
    assert abs(value - expected) < times * standard_deviation, (value, expected)


@pytest.mark.further
@pytest.mark.slow
def test_predicted_uncertainty_is_that_of_a_sample():
    """300 adjustments of a free self-calibrating network with fresh noise.

    A third of σ: error propagation is of first order, and this weak network is curved (with noise
    of σ its Gauss–Newton steps may shrink by a half only).
    """
    part = 1 / 3
    problem = make_problem(synthetic(datum="inner", noise=0.0)[0])
    system, data = problem, problem.data
    random = np.random.default_rng(12)
    noise = random.normal(size=(DRAWS, *data.measured["image"].shape)) / problem.image_weights
    solver = make_solver(problem, max_steps=100)

    @eqx.filter_jit
    def sample(solver, xy):
        def one(xy):
            drawn = eqx.tree_at(lambda d: d.measured["image"], data, xy)
            given = pad_data(system, drawn)
            minimum = minimise(solver, given, given.start)
            cost = minimum.history.cost[minimum.iterations - 1]
            tables, _ = move_to_datum(solver.declared, solver.plan, minimum.values, given.start)
            return minimum.termination, tables, 2 * cost / part**2

        return jax.vmap(one)(xy)

    termination, found, vtpv = sample(solver, data.measured["image"] + part * noise)
    assert (np.asarray(termination) == SETTLED).all()
    true = solved(problem).values
    at_all = lambda rows, name: rows[:, : system.table(name).rows]
    position, rotation = (at_all(x, "image") for x in found["image"])
    turn = jax.vmap(jax.vmap(quaternion_difference), (0, None))(rotation, true["image"].rotation)
    cameras = at_all(found["camera"], "camera") - true["camera"]
    changes = {
        "image": jnp.concatenate([position - true["image"].position, turn], 2),
        "camera": cameras[:, :, problem.free_parameters(0)[1]],
        "point": at_all(found["point"], "point") - true["point"],
    }
    dense = linearise(problem, true)
    Q, x = dense.Q, np.zeros((DRAWS, len(dense.free)))
    for table, columns in dense.columns.items():
        x[:, columns.ravel()] = np.asarray(changes[table]).reshape(DRAWS, -1) / part
    at, x = dense.columns["camera"][0], x[:, dense.free]
    at, Q = np.searchsorted(np.flatnonzero(dense.free), at), Q[np.ix_(dense.free, dense.free)]
    sigma = np.sqrt(np.diag(Q))
    # Every σ: 67 of them, each with a relative error of 1/√(2·300) = 4.1 %.
    ratio = np.sqrt((x**2).mean(0)) / sigma
    assert np.abs(ratio - 1).max() < 4.5 / np.sqrt(2 * DRAWS)
    assert_between(ratio.mean(), 1, 1 / np.sqrt(2 * DRAWS))
    # No bias beyond sampling, and no correlation wrong: χ² of the camera's four parameters.
    # (Not of all unknowns: what is known 1000 times better shows the curvature of the rest.)
    mean = x.mean(0) / sigma * np.sqrt(DRAWS)
    assert np.abs(mean).max() < 4.5
    weight = np.linalg.inv(Q[np.ix_(at, at)])
    square = np.einsum("di,ij,dj->d", x[:, at], weight, x[:, at])
    assert_between(square.mean(), 4, np.sqrt(2 * 4 / DRAWS))
    assert_between(mean[at] * sigma[at] @ weight @ (mean[at] * sigma[at]), 4, np.sqrt(2 * 4))
    # The image of points held in the scene, near and at infinity: the cameras move, nothing of the
    # object is known.
    drawn = (at_all(found["camera"], "camera"), position, rotation, at_all(found["point"], "point"))
    grid = np.stack(np.meshgrid([-6.0, 0.0, 6.0], [-4.0, 4.0]), -1).reshape(-1, 2)
    tables = lambda c, X0, q, X: {"camera": c, "image": PoseValue(X0, q), "point": X}
    for distance in (12.0, np.inf):
        images = images_through_scene(
            get_model("brown"), ("camera", 0), np.arange(6), true, grid, distance
        )
        of = jax.jit(jax.vmap(lambda *drawn, f=images: f(tables(*drawn)) - f(true)))
        stated = np.sqrt(np.diag(Inspection(problem, true).propagate(images)))
        ratio = np.sqrt((np.asarray(of(*drawn)) ** 2).mean(0)) / part / stated
        assert np.abs(ratio - 1).max() < 4.5 / np.sqrt(2 * DRAWS)
    # vᵀPv is χ² of the redundancy.
    f = problem.counts.redundancy
    assert_between(np.mean(vtpv), f, np.sqrt(2 * f / DRAWS))
    assert_between(np.var(vtpv) / (2 * f), 1, np.sqrt((2 + 12 / f) / DRAWS), times=4.5)
