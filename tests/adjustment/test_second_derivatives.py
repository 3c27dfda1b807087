"""Second derivatives of the solution, against differences of whole adjustments.

Everything a program gives (value, first, second derivatives) comes from one compilation; the
differences are of its first derivatives at solutions for changed data.
"""

import dataclasses
from functools import cache
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from adjustment_checks import camera, flat, make, solved, synthetic, vtpv
from test_sensitivity import STENCIL, directions, weights_of_values

import jaxbundle
from jaxbundle.adjustment.jacobian import compiled_jacobian, free_tangent
from jaxbundle.adjustment.residuals import residuals
from jaxbundle.adjustment.sensitivity import attach_derivatives
from jaxbundle.adjustment.solve import solve
from jaxbundle.errors import InputError
from jaxbundle.network.check import check_network
from jaxbundle.solution import minimise

pytestmark = pytest.mark.slow

EXAMPLES = Path(__file__).parents[2] / "examples"
NETWORKS = {
    "control": dict(
        cameras=(camera(free=("c", "K1"), sigma=dict(c=0.01)),), images=4, points=7, control=4,
        distances=((0, 5),),
    ),
    "inner": dict(cameras=(camera(free=("c",)),), images=4, points=7, datum="inner"),
}  # fmt: skip


@cache
def made(name):
    """The problem, and its program: (data, u, w) → S, ∂S/∂w, ∂²S/∂u∂w of a scalar S of all values
    of the solution, along two directions."""
    problem = jaxbundle.make_problem(synthetic(**NETWORKS[name])[0])
    weight = weights_of_values(problem.data.start)

    @eqx.filter_jit
    def program(values, data, u, w):
        def scalar(data):
            adjusted = attach_derivatives(problem.structure, values, data)
            return sum(jax.tree.leaves(jax.tree.map(jnp.vdot, weight, adjusted)))

        along = lambda data: jax.jvp(scalar, (data,), (w,))
        (value, first), (_, second) = jax.jvp(along, (data,), (u,))
        return value, first, second

    return problem, lambda data, u, w: program(solved(problem, data).values, data, u, w)


@pytest.mark.parametrize("name", NETWORKS)
def test_mixed_second_derivatives_by_everything_that_was_given(name):
    problem, program = made(name)
    found = dict(directions(problem, np.random.default_rng(4)))
    found["start camera"] = jax.tree.map(lambda d: 30 * d, found["start camera"])
    second = jax.tree.map(lambda *x: sum(x), *found.values())
    seen = set()
    for field, u in found.items():
        *_, mixed = program(problem.data, u, second)
        turned = program(problem.data, second, u)[2]
        difference = 0.0
        for step, factor in STENCIL:
            data = jax.tree.map(lambda x, d: x + step * d, problem.data, u)  # noqa: B023
            difference += factor * float(program(data, u, second)[1])
        # Symmetric, and what finite differences say.
        assert float(mixed) == pytest.approx(float(turned), rel=1e-7, abs=1e-14), field
        assert float(mixed) == pytest.approx(difference, rel=1e-6, abs=1e-13), field
        seen |= {field} if abs(difference) > 1e-8 else set()
    assert {"image_xy", "image_weight", "start camera"} <= seen
    if name == "control":
        assert {"control", "control_weight", "distance", "interior"} <= seen
    else:
        assert "start point" in seen  # the datum refers to it


def test_a_fixed_point_takes_the_datum_with_it():
    """Free but for a point that is held: where that goes, all goes, and the minimum stays. (The
    rotations and the scale that are open are those about the point.)"""
    problem = make("one fixed point")
    s, data = problem.structure, problem.data
    (held,) = np.flatnonzero(np.asarray(s.point_free)[:, 0] == 0)
    shift = jnp.array([0.3, -0.2, 0.1])
    only = eqx.tree_at(lambda d: d.start.point, data, data.start.point.at[held].add(shift))
    filled_in = minimise(dataclasses.replace(problem, data=only), only.start)
    for minimum in (solved(problem, only), filled_in):
        assert vtpv(dataclasses.replace(problem, data=only), minimum.values) == pytest.approx(
            vtpv(problem, solved(problem).values), rel=1e-9
        )

    @jax.jit
    def moved(values, step):
        at = lambda step: eqx.tree_at(
            lambda d: d.start.point, data, data.start.point.at[held].add(step * shift)
        )
        adjusted = lambda step: attach_derivatives(s, values, at(step)).camera[0, 0]
        return jax.grad(adjusted)(step)

    # A shift of everything moves no principal distance.
    assert abs(moved(solved(problem).values, 0.0)) < 1e-9


def with_observations(data, xy, weight):
    return dataclasses.replace(data, image_xy=xy, image_weight=weight)


def test_gradient_of_a_gradient_through_solve():
    """The reproduction of the fault: f = Σ(∂c/∂xy)², reverse over reverse, in a batch, whose other
    members give the differences; and one that has no solution."""
    network = check_network(jaxbundle.read_network(EXAMPLES / "convergent4" / "project4.toml"))
    problem = jaxbundle.make_problem(network)
    data = problem.data

    def c(xy, weight):
        return solve(problem, with_observations(data, xy, weight), atol=1e-10).camera[0, 0]

    def f(xy, weight):
        return jnp.sum(jax.grad(c)(xy, weight) ** 2)

    at, h, k = (0, 0), 1e-3, 0.02 * float(data.image_weight[0, 0])
    steps = np.array([step for step, _ in STENCIL])
    xy = np.tile(data.image_xy, (2 * len(steps) + 2, 1, 1))
    weight = np.tile(data.image_weight, (len(xy), 1, 1))
    xy[(slice(1, 5), *at)] += h * steps
    weight[(slice(5, 9), *at)] += k * steps
    xy[(9, *at)] = np.nan
    program = jax.jit(jax.vmap(jax.value_and_grad(f, (0, 1))))
    value, (by_xy, by_weight) = (jax.tree.map(np.asarray, program(xy, weight)))
    factors = np.array([factor for _, factor in STENCIL])
    assert by_xy[(0, *at)] == pytest.approx(factors @ value[1:5] / h, rel=1e-4)
    assert by_weight[(0, *at)] == pytest.approx(factors @ value[5:9] / k, rel=1e-4)
    # No solution: no derivative, rather than 0.
    assert np.isnan(value[9]) and np.isnan(by_xy[9]).all()


def test_the_gauss_newton_form_refuses_second_derivatives():
    problem, _ = made("control")

    def scalar(xy):
        data = dataclasses.replace(problem.data, image_xy=xy)
        values = attach_derivatives(problem.structure, data.start, data, "gauss-newton")
        return jnp.sum(values.point)

    with pytest.raises(InputError, match="first derivatives only.*\"exact\""):
        jax.eval_shape(jax.hessian(scalar), problem.data.image_xy)


def test_weights_in_the_gauss_newton_form_as_in_error_propagation():
    """∂x/∂w = −(JᵀPJ)⁻¹·Jᵀ·(∂P/∂w)·v, P = w²: twice the weight, not once."""
    problem, _ = made("control")
    s, data = problem.structure, problem.data
    values = solved(problem).values
    row, axis = 3, 1
    change = jnp.zeros_like(data.image_weight).at[row, axis].set(1.0)

    @jax.jit
    def moved(weight):
        data = dataclasses.replace(problem.data, image_weight=weight)
        return attach_derivatives(s, values, data, "gauss-newton").point

    found = np.asarray(jax.jvp(moved, (data.image_weight,), (change,))[1]).ravel()
    J = np.asarray(compiled_jacobian(s, values, data).as_matrix())
    v = np.asarray(residuals(s, values, data).image)[row, axis]
    free = flat(free_tangent(s)) > 0
    N = (J.T @ J)[np.ix_(free, free)]
    # weighted rows w·J and w·v: ∂(JᵀPv)/∂w = 2·(w·J)ᵀ·(w·v)/w
    right = 2 * J[2 * row + axis, free] * v / float(data.image_weight[row, axis])
    dense = np.zeros(len(free))
    dense[free] = -np.linalg.solve(N, right)
    np.testing.assert_allclose(found, dense[-len(found):], rtol=1e-6, atol=1e-9 * abs(dense).max())
