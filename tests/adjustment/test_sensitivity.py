"""Derivatives of the solution: against central differences of whole adjustments, in both modes,
in batches; the Gauss–Newton form against dense least squares."""

import dataclasses
from functools import cache
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from adjustment_checks import (
    adjusted,
    bordered_inverse,
    datum_matrices,
    flat,
    solved,
)
from jax.flatten_util import ravel_pytree

import jaxbundle
from jaxbundle.adjustment.jacobian import compiled_jacobian, free_tangent
from jaxbundle.adjustment.residuals import residuals
from jaxbundle.adjustment.sensitivity import attach_derivatives
from jaxbundle.adjustment.solve import solve
from jaxbundle.geometry import quaternion_conjugate, quaternion_multiply
from jaxbundle.network.check import check_network

pytestmark = pytest.mark.slow

EXAMPLES = Path(__file__).parents[2] / "examples"

STENCIL = ((1, 8 / 12), (-1, -8 / 12), (2, -1 / 12), (-2, 1 / 12))
"""Central differences of fourth order: with steps of 0.3 σ of an observation (1e-4 of the
principal distance) they are exact to 1e-8, and the last digits of the solutions do not matter."""


def with_xy(data, xy):
    return dataclasses.replace(data, image_xy=xy)


@cache
def all_derivatives(name, sensitivity):
    """∂ values / ∂ image coordinates by forward mode: [values, coordinates], and the values."""
    problem, _ = adjusted(name)

    @eqx.filter_jit
    def forward(data):
        def of_xy(xy):
            values = solve(problem, with_xy(data, xy), sensitivity=sensitivity)
            return ravel_pytree(values)[0]

        return of_xy(data.image_xy), jax.jacfwd(of_xy)(data.image_xy)

    return forward


def exactly(problem, data):
    """With one more Newton step: the iterations stop where the cost, not the unknowns, is exact."""
    return flat(attach_derivatives(problem.structure, solved(problem, data).values, data))


def differences_by_image_coordinates(problem):
    data = problem.data
    columns = []
    for row, axis in np.ndindex(data.image_xy.shape):
        h = 0.3 / float(data.image_weight[row, axis])
        total = 0
        for step, factor in STENCIL:
            xy = data.image_xy.at[row, axis].add(step * h)
            total = total + factor / h * exactly(problem, with_xy(data, xy))
        columns.append(total)
    return np.stack(columns, 1)


def test_all_values_by_all_image_coordinates():
    problem, minimum = adjusted("free")
    values, forward = all_derivatives("free", "exact")(problem.data)
    np.testing.assert_allclose(values, flat(minimum.values), atol=1e-10)
    forward = np.asarray(forward).reshape(values.size, -1)
    difference = differences_by_image_coordinates(problem)
    # Of the largest derivative of every value; fixed ones have none.
    size = np.abs(difference).max(1)
    assert (size > 0).sum() == flat(free_tangent(problem.structure)).sum() + len(
        problem.network.images
    )  # a quaternion has four elements for three unknowns
    error = np.abs(forward - difference).max(1) / np.where(size > 0, size, 1)
    assert error.max() <= 1e-6


def weights_of_values(values):
    """A scalar function of everything in a solution: random weights for all values."""
    rng = np.random.default_rng(5)
    return jax.tree.map(lambda x: jnp.asarray(rng.normal(size=x.shape)), values)


@cache
def gradient_of(name):
    """The gradient of one scalar of the solution by every field of the data, by reverse mode."""
    problem, minimum = adjusted(name)
    weight = weights_of_values(minimum.values)

    def scalar(data, sensitivity="exact"):
        products = jax.tree.map(jnp.vdot, weight, solve(problem, data, sensitivity=sensitivity))
        return sum(jax.tree.leaves(products))

    return scalar


def test_reverse_mode_in_batches_gives_the_same_as_forward_mode():
    problem, minimum = adjusted("free")
    rng = np.random.default_rng(8)
    noise = rng.normal(size=(3, *problem.data.image_xy.shape)) / np.asarray(
        problem.data.image_weight
    )
    noise[0] = 0
    xy = problem.data.image_xy + noise
    scalar = gradient_of("free")
    batched = eqx.filter_jit(
        jax.vmap(jax.value_and_grad(lambda xy: scalar(with_xy(problem.data, xy))))
    )
    found, reverse = batched(xy)
    weight = flat(weights_of_values(minimum.values))
    for k in range(len(xy)):
        values, forward = all_derivatives("free", "exact")(with_xy(problem.data, xy[k]))
        assert float(found[k]) == pytest.approx(float(weight @ values), abs=1e-9)
        expected = np.tensordot(weight, forward, 1)
        np.testing.assert_allclose(
            reverse[k], expected, rtol=1e-10, atol=1e-10 * np.abs(expected).max()
        )


FIELDS = ("image_xy", "image_weight", "control", "control_weight", "exterior", "exterior_weight",
          "interior", "interior_weight", "distance", "distance_weight")  # fmt: skip


def direction_in(data, name, rng):
    """A random change of one field: 0.05 σ of a value, 0.3 % of a weight."""
    value = getattr(data, name)
    if name.endswith("_weight"):
        change = 0.003 * rng.normal(size=value.shape) * value
    else:
        weight = getattr(data, "image_weight" if name == "image_xy" else f"{name}_weight")
        inverse = jnp.where(weight > 0, 1 / jnp.where(weight > 0, weight, 1), 0)
        change = 0.05 * rng.normal(size=value.shape) * inverse
    zero = jax.tree.map(jnp.zeros_like, data)
    return eqx.tree_at(lambda d: getattr(d, name), zero, change)


def directions(problem, rng):
    """Changes of every kind of given quantity that the network has, by name."""
    data = problem.data
    zero = jax.tree.map(jnp.zeros_like, data)
    for name in FIELDS:
        if getattr(data, name).size:
            yield name, direction_in(data, name, rng)
    start = data.start
    moves = {
        "position": 3e-4 * rng.normal(size=start.position.shape),
        "point": 3e-4 * rng.normal(size=start.point.shape),
        "camera": 3e-5 * rng.normal(size=start.camera.shape) * start.camera,
        "rotation": 3e-5 * rng.normal(size=start.rotation.shape),
    }
    for name, move in moves.items():
        at = lambda d, name=name: getattr(d.start, name)
        yield f"start {name}", eqx.tree_at(at, zero, jnp.asarray(move))


@pytest.mark.parametrize(
    "name",
    [
        "shared cameras of two models",
        "held images, exterior priors",
        "minimal",
    ],
)
def test_by_everything_that_was_given(name):
    problem, minimum = adjusted(name)
    weight = flat(weights_of_values(minimum.values))
    gradient = reverse_gradient(name)
    rng = np.random.default_rng(2)
    seen = []
    for field, direction in directions(problem, rng):
        slope = flat(gradient) @ flat(direction)
        difference = 0.0
        for step, factor in STENCIL:
            data = jax.tree.map(lambda x, d: x + step * d, problem.data, direction)  # noqa: B023
            difference += factor * (weight @ exactly(problem, data))
        # Start values of what is neither held nor in the datum have no influence: 0 = 0.
        assert slope == pytest.approx(difference, rel=1e-6, abs=3e-10), field
        seen.append((field, abs(difference) > 1e-6))
    influential = {field for field, counts in seen if counts}
    assert influential >= {"image_xy", "image_weight"}
    assert "start camera" in influential  # the fixed parameters
    held = [problem.structure.image_free, problem.structure.point_free]
    if problem.structure.defect or not flat(held).all():
        assert {"start point", "start position"} & influential


@cache
def reverse_gradient(name):
    problem, _ = adjusted(name)
    return eqx.filter_jit(jax.grad(gradient_of(name)))(problem.data)


def as_tangent(values, derivative):
    """Derivatives of values as those of the free unknowns: quaternions as small rotations."""
    turn = jax.vmap(lambda q, d: 2 * quaternion_multiply(d, quaternion_conjugate(q))[1:])
    return derivative.position, turn(values.rotation, derivative.rotation)


@pytest.mark.parametrize("name", ["free"])
def test_gauss_newton_form_is_that_of_error_propagation(name):
    problem, minimum = adjusted(name)
    s, data, values = problem.structure, problem.data, minimum.values
    found, forward = all_derivatives(name, "gauss-newton")(data)
    np.testing.assert_allclose(found, flat(values), atol=1e-10)
    forward = np.asarray(forward).reshape(found.size, -1)
    unravel = ravel_pytree(values)[1]
    columns = []
    for column in forward.T:
        d = unravel(jnp.asarray(column))
        position, turn = as_tangent(values, d)
        camera = d.camera[:, np.asarray(s.camera_columns[0])]
        columns.append(np.concatenate([
            np.concatenate([position, turn], 1).ravel(), np.ravel(camera), np.ravel(d.point)
        ]))  # fmt: skip
    found = np.stack(columns, 1)

    J = np.asarray(compiled_jacobian(s, values, data).as_matrix())
    _, B = datum_matrices(s, values)
    Q = bordered_inverse(J.T @ J, B, np.ones(len(J.T)))
    rows = lambda xy: ravel_pytree(residuals(s, values, with_xy(data, xy)))[0]
    by_xy = np.asarray(jax.jit(jax.jacfwd(rows))(data.image_xy)).reshape(len(J), -1)
    dense = -Q @ J.T @ by_xy
    size = np.abs(dense).max(1, keepdims=True)
    assert (np.abs(found - dense) / size).max() < 1e-9
    # It is not the exact one: they differ by the curvature, of the order of v/c.
    exact = np.asarray(all_derivatives(name, "exact")(data)[1]).reshape(forward.shape)
    apart = np.abs(exact - forward).max() / np.abs(exact).max()
    assert 1e-6 < apart < 1e-1


# --- the four photographs -------------------------------------------------------------------

DRAWS = 100
NOISE = 0.65e-3
"""σ0 of the four photographs with four camera parameters, mm."""


@pytest.fixture(scope="module")
def photographs():
    """The problem, and c with its derivatives by all image coordinates, by reverse and by forward
    mode, for `DRAWS` sets of coordinates at once."""
    network = check_network(jaxbundle.read_network(EXAMPLES / "convergent4" / "project4.toml"))
    problem = jaxbundle.make_problem(network)
    distance = lambda xy: solve(problem, with_xy(problem.data, xy)).camera[0, 0]

    def derivatives(xy):
        c, forward = jax.linearize(distance, xy)
        each = jnp.eye(xy.size).reshape(-1, *xy.shape)
        reverse, = jax.linear_transpose(forward, xy)(jnp.ones_like(c))
        return c, reverse, jax.vmap(forward)(each).reshape(xy.shape)

    batched = jax.jit(jax.vmap(derivatives))
    return problem, lambda xy: map(np.asarray, batched(jnp.asarray(xy)))


def test_principal_distance_of_the_photographs_by_all_image_coordinates(photographs):
    problem, derivatives = photographs
    xy = np.asarray(problem.data.image_xy)
    assert xy.size == 80
    h = 1e-3  # mm
    steps = np.eye(xy.size).reshape(-1, *xy.shape)
    shifts = np.concatenate([k * h * steps for k, _ in STENCIL] + [0 * steps])
    batches = (xy + shifts).reshape(-1, DRAWS, *xy.shape)
    c, reverse, _ = (np.concatenate(x) for x in zip(*map(derivatives, batches)))
    c = c.reshape(-1, xy.size)
    difference = sum(weight / h * moved for (_, weight), moved in zip(STENCIL, c))
    difference = difference.reshape(xy.shape)
    assert np.abs(reverse[-1] - difference).max() < 1e-6 * np.abs(difference).max()


def test_gradients_of_a_hundred_noisy_copies_at_once(photographs):
    """Forward and reverse mode agree in every one, and gradients carry the noise from one to the
    next."""
    problem, derivatives = photographs
    xy = np.asarray(problem.data.image_xy)
    noise = np.random.default_rng(3).normal(0, NOISE, (DRAWS, *xy.shape))
    c, reverse, forward = derivatives(xy + noise)
    size = np.abs(forward).max((1, 2), keepdims=True)
    assert (np.abs(reverse - forward) < 1e-10 * size).all()
    # the trapezoidal rule: what is left is of third order in the noise
    along = 0.5 * ((reverse[1:] + reverse[:-1]) * np.diff(noise, axis=0)).sum((1, 2))
    np.testing.assert_allclose(np.diff(c), along, atol=0.01 * np.abs(along).max())


def test_check_gradients_of_an_adjustment(photographs):
    found = jaxbundle.check_gradients(photographs[0], directions=3)
    assert found.passed, str(found)
