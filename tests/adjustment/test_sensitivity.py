"""Derivatives of the solution of a network, first and second, by everything that was given: against
central differences of whole adjustments, in both modes, in a batch; the Gauss–Newton form against
dense least squares. (The engine's own: tests/leastsquares/test_derivatives.py.)
"""

import dataclasses
from functools import cache

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from adjustment_checks import adjusted, camera, flat, linearise, solved, synthetic, vtpv

import jaxbundle
from jaxbundle.adjustment.problem import make_problem
from jaxbundle.adjustment.solve import solve
from jaxbundle.leastsquares.derivatives import attach_derivatives
from jaxbundle.leastsquares.problem import given_data, pad_values, without_filling

pytestmark = pytest.mark.slow

STENCIL = ((1, 8 / 12), (-1, -8 / 12), (2, -1 / 12), (-2, 1 / 12))
"""Central differences of fourth order: with steps of 0.3 σ of an observation (1e-4 of the
principal distance) they are exact to 1e-8, and the last digits of the solutions do not matter."""


def attached(problem, values, data, sensitivity="exact"):
    """The solution `values` for `data` as a function of them."""
    system = problem.system
    tables = pad_values(system, problem.layout.tables(values))
    given = given_data(system, problem.layout.data(data))
    found = attach_derivatives(system.declared, system.plan, tables, given, sensitivity)
    return problem.layout.values(without_filling(system, found))


@cache
def program():
    """Of a network with everything that can be given: (data, u, w) → S, ∂S/∂u, ∂S/∂w, ∂²S/∂u∂w of a
    scalar S of all values of the solution, along two directions. (Its points are tied by distances,
    and so all kept: half of the program. Others are eliminated in what follows.)"""
    network, _ = synthetic(
        cameras=(camera(model="snavely", free=("f",), sigma=dict(f=0.2)),), images=3, points=5,
        control=4, distances=((0, 1), (2, 3), (3, 4)), exterior_prior=True, domain="measured",
    )  # fmt: skip
    problem, random = make_problem(network), np.random.default_rng(5)
    weight = jax.tree.map(lambda x: random.normal(size=x.shape), problem.data.start)

    @eqx.filter_jit
    def derivatives(values, data, u, w):
        def scalar(data):
            products = jax.tree.map(jnp.vdot, weight, attached(problem, values, data))
            return sum(jax.tree.leaves(products))

        along = lambda data: jax.jvp(scalar, (data,), (w,))
        (value, by_w), (by_u, both) = jax.jvp(along, (data,), (u,))
        return value, by_u, by_w, both

    return problem, lambda data, u, w: map(
        float, derivatives(solved(problem, data).values, data, u, w)
    )


FIELDS = ("image_xy", "image_weight", "control", "control_weight", "exterior", "exterior_weight",
          "interior", "interior_weight", "distance", "distance_weight")  # fmt: skip


def directions(data, random):
    """Random changes of one field each: 0.05 σ of a value, 0.3 % of a weight; start values."""
    zero = jax.tree.map(jnp.zeros_like, data)
    for name in FIELDS:
        value = getattr(data, name)
        if name.endswith("_weight"):
            change = 0.003 * random.normal(size=value.shape) * value
        else:
            weight = getattr(data, "image_weight" if name == "image_xy" else f"{name}_weight")
            inverse = jnp.where(weight > 0, 1 / jnp.where(weight > 0, weight, 1), 0)
            change = 0.05 * random.normal(size=value.shape) * inverse
        yield name, eqx.tree_at(lambda d, n=name: getattr(d, n), zero, change)
    camera = data.start.camera
    change = 0.001 * random.normal(size=camera.shape) * camera  # fixed parameters, here
    yield "start camera", eqx.tree_at(lambda d: d.start.camera, zero, change)


def test_first_and_second_derivatives_by_everything_that_was_given():
    problem, of = program()
    found = dict(directions(problem.data, np.random.default_rng(4)))
    together = jax.tree.map(lambda *x: sum(x), *found.values())
    for field, u in found.items():
        _, first, _, second = of(problem.data, u, together)
        *_, turned = of(problem.data, together, u)
        differences = np.zeros(2)
        for step, factor in STENCIL:
            data = jax.tree.map(lambda x, d: x + step * d, problem.data, u)  # noqa: B023
            value, _, by_w, _ = of(data, u, together)
            differences += factor * np.array([value, by_w])
        assert first == pytest.approx(differences[0], rel=1e-6, abs=1e-10), field
        # Symmetric, and what finite differences say.
        assert second == pytest.approx(turned, rel=1e-7, abs=1e-14), field
        assert second == pytest.approx(differences[1], rel=1e-6, abs=1e-12), field
        assert abs(first) > 1e-7 and abs(second) > 1e-9, field


def test_a_fixed_point_takes_the_datum_with_it():
    """Free but for a point that is held: where that goes, all goes, and the minimum stays. (The
    rotations and the scale that are open are those about the point.)"""
    problem, minimum = adjusted("one fixed point")
    start, shift = problem.data.start, jnp.array([0.3, -0.2, 0.1])
    moved = dataclasses.replace(start, point=start.point.at[0].add(shift))
    only = dataclasses.replace(problem.data, start=moved)
    found = solved(problem, only)
    expected = vtpv(problem, minimum.values)
    assert vtpv(problem.with_data(only), found.values) == pytest.approx(expected, rel=1e-9)
    # A shift of everything moves no principal distance.
    np.testing.assert_allclose(found.values.camera, minimum.values.camera, rtol=1e-8, atol=1e-11)


def test_the_gauss_newton_form_is_that_of_error_propagation():
    """∂x/∂xy = −Q·Jᵀ·∂v/∂xy; ∂x/∂w = −2·Q·Jᵀ·v/w: twice the weight, P = w², not once."""
    problem, minimum = adjusted("free")
    data, values = problem.data, minimum.values

    @jax.jit
    def both(data):
        def points(xy, weight):
            given = dataclasses.replace(data, image_xy=xy, image_weight=weight)
            return attached(problem, values, given, "gauss-newton").point.ravel()

        return jax.jacfwd(points, (0, 1))(data.image_xy, data.image_weight)

    by_xy, by_weight = (np.asarray(x).reshape(len(x), -1) for x in both(data))
    dense = linearise(problem, values)
    # Image coordinates are corrected in the "corrected" domain: ∂v/∂xy is not 1/σ.
    h, slopes = 1e-6, []
    for axis in (0, 1):
        ends = [
            linearise(problem, values, dataclasses.replace(
                data, image_xy=data.image_xy.at[:, axis].add(step * h)
            )).v for step, _ in STENCIL
        ]  # fmt: skip
        slopes.append(sum(factor / h * v for (_, factor), v in zip(STENCIL, ends)).reshape(-1, 2))
    rays = len(data.image_xy)
    by = np.zeros((rays, 2, rays, 2))
    by[np.arange(rays), :, np.arange(rays)] = np.stack(slopes, 2)
    QJ = (dense.Q @ dense.J.T)[dense.columns["point"].ravel()]
    expected = -QJ @ by.reshape(2 * rays, -1)
    size = np.abs(expected).max(1, keepdims=True)
    assert (np.abs(by_xy - expected) / size).max() < 1e-7  # of the differences in `by`
    expected = -2 * QJ * dense.v / np.ravel(data.image_weight)
    assert np.abs(by_weight - expected).max() < 1e-8 * np.abs(expected).max()
    # It is not the exact one: they differ by the curvature, of the order of v/c.
    h, exact = 0.3 / float(data.image_weight[0, 0]), 0.0
    for step, factor in STENCIL:
        xy = data.image_xy.at[0, 0].add(step * h)
        found = solved(problem, dataclasses.replace(data, image_xy=xy))
        exact = exact + factor / h * flat(found.values.point)
    apart = np.abs(exact - by_xy[:, 0]).max() / np.abs(exact).max()
    assert 1e-5 < apart < 1e-1


@pytest.fixture(scope="module")
def resection():
    """Two images of fixed points: the smallest program."""
    network, _ = synthetic(
        cameras=(camera(model="snavely", free=()),), images=2, points=7, fixed=7,
        domain="measured",
    )  # fmt: skip
    return make_problem(network)


def test_gradient_of_a_gradient_through_solve(resection):
    """f = Σ(∂X0/∂xy)², reverse over reverse, in a batch, whose other members give the differences;
    and one that has no solution."""
    data = resection.data

    def X0(xy):
        given = dataclasses.replace(data, image_xy=xy)
        return solve(resection, given, atol=1e-10).position[0, 0]

    @jax.jit
    @jax.vmap
    @jax.value_and_grad
    def f(xy):
        return jnp.sum(jax.grad(X0)(xy) ** 2)

    at, h = (0, 0), 0.3 / float(data.image_weight[0, 0])
    steps = np.array([step for step, _ in STENCIL])
    xy = np.tile(data.image_xy, (len(steps) + 2, 1, 1))
    xy[(slice(1, 5), *at)] += h * steps
    xy[(5, *at)] = np.nan
    value, by_xy = map(np.asarray, f(xy))
    factors = np.array([factor for _, factor in STENCIL])
    assert by_xy[(0, *at)] == pytest.approx(factors @ value[1:5] / h, rel=1e-4)
    # No solution: no derivative, rather than 0.
    assert np.isnan(value[5]) and np.isnan(by_xy[5]).all()


def test_check_gradients_of_an_adjustment(resection):
    found = jaxbundle.check_gradients(resection, directions=3)
    assert found.passed, str(found)
