"""Derivatives of the solution of a network by everything that was given: against central
differences of whole adjustments, in both modes. (The engine's own, of the second order
and of Gauss–Newton: tests/leastsquares/test_derivatives.py; of any order: tests/test_implicit.py.)
"""

import dataclasses
from functools import cache

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from adjustment_checks import adjusted, camera, solved, synthetic, vtpv

import jaxbundle
from jaxbundle.adjustment.problem import make_problem
from jaxbundle.leastsquares.problem import complete_data, pad_values, with_data, without_filling
from jaxbundle.leastsquares.quality.derivatives import attach_derivatives

pytestmark = pytest.mark.slow

STENCIL = ((1, 8 / 12), (-1, -8 / 12), (2, -1 / 12), (-2, 1 / 12))
"""Central differences of fourth order: with steps of 0.3 σ of an observation (1e-4 of the
principal distance) they are exact to 1e-8, and the last digits of the solutions do not matter."""


def attached(problem, values, data, sensitivity="exact"):
    """The solution `values` for `data` as a function of them."""
    system = problem
    tables = pad_values(system, values)
    given = complete_data(system, data)
    found = attach_derivatives(system.declared, system.plan, tables, given, sensitivity)
    return without_filling(system, found)


@cache
def program():
    """Of a network with everything that can be given: (data, u) → S, ∂S/∂u of a scalar S of all
    values of the solution. (Its points are tied by distances, and so all kept: half of the program.
    Others are eliminated in what follows.)"""
    network, _ = synthetic(
        cameras=(camera(model="snavely", free=("f",), sigma=dict(f=0.2)),), images=3, points=5,
        control=4, distances=((0, 1), (2, 3), (3, 4)), exterior_prior=True, domain="measured",
    )  # fmt: skip
    problem, random = make_problem(network), np.random.default_rng(5)
    weight = jax.tree.map(lambda x: random.normal(size=x.shape), problem.data.start)

    @eqx.filter_jit
    def derivative(values, data, u):
        def scalar(data):
            products = jax.tree.map(jnp.vdot, weight, attached(problem, values, data))
            return sum(jax.tree.leaves(products))

        return jax.jvp(scalar, (data,), (u,))

    return problem, lambda data, u: map(
        float, derivative(solved(problem, data).values, data, u)
    )


SETS = ("image", "control", "exterior", "interior", "distance")


def directions(data, random):
    """Random changes of the values or the weights of one set each: 0.05 σ of a value, 0.3 % of a
    weight; start values."""
    zero = jax.tree.map(jnp.zeros_like, data)
    for name in SETS:
        value, weight = data.measured[name], data.weight[name]
        change = 0.003 * random.normal(size=weight.shape) * weight
        yield f"weight of {name}", eqx.tree_at(lambda d, n=name: d.weight[n], zero, change)
        inverse = jnp.where(weight > 0, 1 / jnp.where(weight > 0, weight, 1), 0)
        change = 0.05 * random.normal(size=value.shape) * inverse.reshape(value.shape)
        yield name, eqx.tree_at(lambda d, n=name: d.measured[n], zero, change)
    camera = data.start["camera"]
    change = 0.001 * random.normal(size=camera.shape) * camera  # fixed parameters, here
    yield "start camera", eqx.tree_at(lambda d: d.start["camera"], zero, change)


@pytest.mark.further
def test_derivatives_by_everything_that_was_given():
    """First ones; of the second, by the same rule: the engine's own tests, and below."""
    problem, of = program()
    for field, u in directions(problem.data, np.random.default_rng(4)):
        _, first = of(problem.data, u)
        difference = 0.0
        for step, factor in STENCIL:
            data = jax.tree.map(lambda x, d: x + step * d, problem.data, u)  # noqa: B023
            difference += factor * next(of(data, u))
        assert first == pytest.approx(difference, rel=1e-6, abs=1e-10), field
        assert abs(first) > 1e-7, field


def test_a_fixed_point_takes_the_datum_with_it():
    """Free but for one held point: if that moves, all points move with it, and the minimum stays.
    (The rotations and the scale that are open are those about the point.)"""
    problem, minimum = adjusted("one fixed point")
    start, shift = problem.data.start, jnp.array([0.3, -0.2, 0.1])
    moved = start | {"point": start["point"].at[0].add(shift)}
    only = dataclasses.replace(problem.data, start=moved)
    found = solved(problem, only)
    expected = vtpv(problem, minimum.values)
    assert vtpv(with_data(problem, only), found.values) == pytest.approx(expected, rel=1e-9)
    # A shift of everything moves no principal distance.
    np.testing.assert_allclose(
        found.values["camera"], minimum.values["camera"], rtol=1e-8, atol=1e-11
    )


@pytest.fixture(scope="module")
def resection():
    """Two images of fixed points: the smallest program."""
    network, _ = synthetic(
        cameras=(camera(model="snavely", free=()),), images=2, points=7, fixed=7,
        domain="measured",
    )  # fmt: skip
    return make_problem(network)


def test_check_gradients_of_an_adjustment(resection):
    found = jaxbundle.check_gradients(resection, directions=3)
    assert found.passed, str(found)
