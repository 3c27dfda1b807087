"""Derivatives of the solution and of its precision, against central differences and dense algebra.

`trilateration`: points in the plane by their distances, one of them held, the net free to turn
about it; `photographs`: poses, points that are eliminated or kept, a camera with a full prior.
"""

import dataclasses
from functools import cache

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree

from jaxbundle.errors import InputError
from jaxbundle.geometry import matrix_from_quaternion
from jaxbundle.leastsquares.datum.conditions import (
    generators,
    keep_held_fixed,
    of_groups,
    zeros_of_tables,
)
from jaxbundle.leastsquares.declarations import Kind, Motions, Table
from jaxbundle.leastsquares.equations.hessian import equations_and_terms
from jaxbundle.leastsquares.equations.normal import Normal, zero_tangent
from jaxbundle.leastsquares.indexing.rows import _look_up_in_copies, lay_out_data, look_up
from jaxbundle.leastsquares.iterations.retraction import retract
from jaxbundle.leastsquares.iterations.solver import minimise
from jaxbundle.leastsquares.problem import (
    complete_data,
    make_problem,
    make_solver,
    without_filling,
)
from jaxbundle.leastsquares.quality.derivatives import attach_derivatives, solve
from jaxbundle.leastsquares.quality.hessian_products import multiply
from jaxbundle.leastsquares.quality.precision import precision
from jaxbundle.leastsquares.spaces import Pose, PoseValue

find_minimum = eqx.filter_jit(minimise)

pytestmark = pytest.mark.slow

# ---------------------------------------------------------------------- two problems

DISTANCE = Kind(
    "distance", lambda a, b, device, d: device + jnp.linalg.norm(a - b) - d,
    of=("point", "point", "device"), invariant=True,
)  # fmt: skip


def turn_and_shift(motion, point):
    """Along (shift, rotation) for a unit of time."""
    angle, half = motion[2], motion[2] / 2
    sine, cosine = jnp.sinc(angle / jnp.pi), half * jnp.sinc(half / jnp.pi) ** 2
    R = jnp.array([[jnp.cos(angle), -jnp.sin(angle)], [jnp.sin(angle), jnp.cos(angle)]])
    return R @ point + jnp.array([[sine, -cosine], [cosine, sine]]) @ motion[:2]


MOTIONS = Motions(("shift x", "shift y", "rotation"), (("point", turn_and_shift),), (2,))


def trilateration(held, **options):
    random = np.random.default_rng(1)
    point = 100 * random.random((5, 2))
    i, j = np.triu_indices(len(point), 1)
    measured = np.linalg.norm(point[i] - point[j], axis=1) + 0.3 * random.normal(size=len(i))
    free = np.ones((len(point), 2))
    if held:
        free[2] = 0
    weight = np.ones((len(point), 2))
    weight[0] = 0
    start = point + 3 * random.normal(size=point.shape)
    sigma = 0.2 + 0.2 * random.random(len(i))
    devices = Table("device", np.zeros(2), free=np.array([True, False]))
    return make_problem(
        [Table("point", start, free=free), devices],
        [DISTANCE((i, j, np.arange(len(i)) % 2), measured, sigma=sigma)],
        motions=MOTIONS, datum=lambda gauge: ({"point": weight}, False), **options,
    )  # fmt: skip


def seen(pose, camera, point, xy):
    x, y, z = pose.ray(point)
    return camera[0] * x / z + camera[1] - xy[0], camera[0] * y / z + camera[2] - xy[1]


SEEN = Kind("image point", seen, of=("pose", "camera", "point"), scalars=True)
IDEAL = Kind(
    "image point", lambda pose, point, xy: seen(pose, (1.0, 0.02, 0.01), point, xy),
    of=("pose", "point"), scalars=True,
)  # fmt: skip
CAMERA = Kind("camera", lambda camera, given: camera - given, of=("camera",))
TIE = Kind("height difference", lambda a, b, d: b[2] - a[2] - d, of=("point", "point"))


def photographs(of_known_camera=False):
    random = np.random.default_rng(3)
    points, poses = 7, 3
    point = random.uniform(-1, 1, (points, 3)) * [2, 2, 0.7]
    centre = np.array([[-1.5, 0.2, -5], [1.4, -0.3, -5.2], [0.1, 1.5, -4.6]])
    q = np.concatenate([np.ones((poses, 1)), 0.1 * random.normal(size=(poses, 3))], 1)
    q /= np.linalg.norm(q, axis=1, keepdims=True)
    camera = np.array([[1.0, 0.02, 0.01]])  # c, x0 and, held, y0
    i, p = (x.ravel() for x in np.indices((poses, points)))
    M = np.asarray(jax.vmap(matrix_from_quaternion)(q))
    sight = np.einsum("nij,nj->ni", M[i], point[p] - centre[i])
    u, v = (sight[:, :2] / sight[:, 2:]).T
    xy = np.stack([u, v], 1) + camera[0, 1:] + 2e-3 * random.normal(size=(len(i), 2))
    free_points = np.ones((points, 3))
    free_points[4:] = 0
    start = point + 0.02 * random.normal(size=point.shape) * free_points
    free_cameras = np.array([[1, 1, 0]])
    a, b = np.array([0, 1]), np.array([1, 2])
    ties = point[b, 2] - point[a, 2] + 2e-3 * random.normal(size=2)
    A = 0.02 * (np.eye(3) + 0.3 * random.normal(size=(1, 3, 3)))
    pose = Table("pose", PoseValue(centre + 0.02 * random.normal(size=(poses, 3)), q), Pose())
    point = Table("point", start, free=free_points)
    if of_known_camera:
        return make_problem([pose, point], [IDEAL((i, p), xy, sigma=2e-3)], "point")
    return make_problem(
        [pose, Table("camera", camera, free=free_cameras), point],
        [
            SEEN((i, np.zeros_like(i), p), xy, sigma=2e-3),
            CAMERA((np.zeros(1, int),), camera + 0.01, covariance=A @ A.transpose(0, 2, 1)),
            TIE((a, b), ties, sigma=3e-3),
        ],
        "point",
    )  # fmt: skip


PROBLEMS = {
    "a point held": lambda: trilateration(True),
    "inner constraints": lambda: trilateration(False),
    "conjugate gradients": lambda: trilateration(True, reduction="iterative"),
    "photographs": photographs,
    "of a known camera": lambda: photographs(True),
}


@cache
def made(name):
    return PROBLEMS[name]()


# ---------------------------------------------------------------------- the same without the engine


def residuals(problem, values, data):
    """v/σ of all observations, one after the other as they were given."""
    found = []
    for given in problem.observations:
        blocks = []
        for name, rows in zip(given.kind.of, given.rows):
            of_rows = jax.tree.map(lambda x, rows=rows: x[rows], values[name])
            poses = isinstance(values[name], PoseValue)
            blocks.append(jax.vmap(Pose().prepare)(of_rows) if poses else of_rows)
        v = jax.vmap(given.kind.residual)(*blocks, data.measured[given.name])
        weight = data.weight[given.name]
        v = jnp.stack(v, -1) if isinstance(v, tuple) else v.reshape(len(v), -1)
        found.append(weight * v if weight.ndim == 2 else jnp.einsum("nij,nj->ni", weight, v))
    return jnp.concatenate([v.ravel() for v in found])


def after(problem, values):
    """A change of all unknowns in one vector -> the tables; and which of them are free."""
    padded = complete_data(problem, dataclasses.replace(problem.data, start=values)).start
    zero, unravel = ravel_pytree(zero_tangent(problem.plan))
    free = ravel_pytree({name: g.free for name, g in problem.plan.groups.items()})[0]
    moved = lambda x: retract(problem.declared, problem.plan, padded, unravel(x * free))
    return lambda x: without_filling(problem, moved(x)), zero, np.asarray(free) > 0


@pytest.mark.parametrize("name", ["a point held", "photographs"])
def test_hessian_is_that_of_the_dense_cost(name):
    problem = made(name)
    data = complete_data(problem, None)
    moved, zero, free = after(problem, problem.data.start)
    cost = lambda x: 0.5 * jnp.sum(residuals(problem, moved(x), problem.data) ** 2)

    declared, plan = problem.declared, problem.plan
    change = np.random.default_rng(5).normal(size=zero.shape)
    unravel = ravel_pytree({name: g.free for name, g in plan.groups.items()})[1]

    @jax.jit
    def both():
        laid = lay_out_data(plan, data)
        equations, terms = equations_and_terms(declared, plan, data.start, laid)
        H = Normal(plan, equations[2]).as_matrix()
        product = multiply(declared, plan, data.start, terms, unravel(jnp.asarray(change)))
        ours = (*equations[:2], H, ravel_pytree(product)[0])
        return ours, (cost(zero), jax.grad(cost)(zero), jax.hessian(cost)(zero))

    (value, gradient, H, product), dense = both()
    assert float(value) == pytest.approx(float(dense[0]), rel=1e-12)
    gradient = ravel_pytree(gradient)[0]
    np.testing.assert_allclose(gradient, dense[1], atol=1e-12 * np.abs(dense[1]).max())
    size = np.sqrt(np.diag(np.where(free, dense[2], np.eye(len(free)))).clip(1e-6))
    np.testing.assert_allclose(H / size / size[:, None], dense[2] / size / size[:, None], atol=1e-9)
    # Held unknowns neither change nor are changed.
    expected = np.where(free, dense[2] @ np.where(free, change, 0), 0)
    largest = np.abs(expected / size).max()
    np.testing.assert_allclose(product / size, expected / size, atol=1e-9 * largest)
    if name == "photographs":  # Some points are eliminated, some kept.
        assert problem.plan.groups["point (kept)"].free.sum() == 9


# ---------------------------------------------------------------------- of the solution

STENCIL = ((1, 8 / 12), (-1, -8 / 12), (2, -1 / 12), (-2, 1 / 12))
"""Central differences of fourth order."""


def directions(problem, size):
    """Random changes of the start values, of what was measured, of the weights, each by itself."""
    random, data = np.random.default_rng(4), jax.tree.map(np.asarray, problem.data)
    zero = jax.tree.map(np.zeros_like, data)
    noise = lambda x, scale: scale * random.normal(size=x.shape)
    for name, weight in data.weight.items():
        sigma = 1 / np.abs(weight).max()
        change = noise(data.measured[name], 0.3 * sigma)
        yield f"{name}: measured", eqx.tree_at(lambda d, name=name: d.measured[name], zero, change)
        lower = weight if weight.ndim == 2 else np.tril(weight)
        change = lower * noise(weight, 0.01)
        yield f"{name}: weight", eqx.tree_at(lambda d, name=name: d.weight[name], zero, change)
    for name, value in data.start.items():
        scale = size if name == "point" else 0.01
        change = jax.tree.map(lambda x, scale=scale: noise(x, scale), value)
        if name == "pose":
            change = change._replace(rotation=change.rotation * 0)
        yield f"start: {name}", eqx.tree_at(lambda d, name=name: d.start[name], zero, change)


def along(data, u, step):
    return jax.tree.map(lambda x, d: np.asarray(x) + step * d, data, u)


def scalar_of(problem, values, data):
    """S, a scalar of all values of the solution."""
    random = np.random.default_rng(5)
    factors = jax.tree.map(lambda x: random.normal(size=x.shape), problem.data.start)
    padded = complete_data(problem, data)
    solution = attach_derivatives(problem.declared, problem.plan, values, padded)
    found = without_filling(problem, solution)
    return sum(jax.tree.leaves(jax.tree.map(jnp.vdot, factors, found)))


@cache
def program(name):
    """(data, u, w) → S, ∂S/∂u, ∂S/∂w, ∂²S/∂u∂w."""
    problem = made(name)

    @jax.jit
    def derivatives(values, data, u, w):
        scalar = lambda data: scalar_of(problem, values, data)
        by_w = lambda data: jax.jvp(scalar, (data,), (w,))
        (value, by_w), (by_u, both) = jax.jvp(by_w, (data,), (u,))
        return value, by_u, by_w, both

    return lambda data, u, w: derivatives(minimum(problem, data), data, u, w)


def minimum(problem, data):
    data = complete_data(problem, data)
    return find_minimum(make_solver(problem, atol=1e-7), data, data.start).values


@pytest.mark.parametrize(
    "name", ["a point held", pytest.param("of a known camera", marks=pytest.mark.further)]
)
def test_first_and_second_derivatives_by_everything_that_was_given(name):
    problem, of = made(name), program(name)
    found = dict(directions(problem, 0.3 if name == "a point held" else 2e-3))
    together = jax.tree.map(lambda *x: sum(x), *found.values())
    moving, h = set(), 0.2
    for field, u in found.items():
        _, first, _, second = of(problem.data, u, together)
        turned = of(problem.data, together, u)[3]
        differences = np.zeros(2)
        for step, factor in STENCIL:
            value, _, by_w, _ = of(along(problem.data, u, h * step), u, together)
            differences += factor / h * np.array([value, by_w])
        assert float(first) == pytest.approx(differences[0], rel=1e-6, abs=1e-11), field
        assert float(second) == pytest.approx(float(turned), rel=1e-7, abs=1e-12), field
        assert float(second) == pytest.approx(differences[1], rel=1e-5, abs=1e-10), field
        moving |= {field} if abs(second) > 1e-8 else set()
    # Start values count where they are held or hold the datum.
    assert moving == set(found) - {"start: pose"}


@pytest.mark.further
def test_conjugate_gradients_give_the_same_as_a_factor():
    """S and its derivative by everything, as above; the precision of points."""
    problem = made("a point held")
    u = jax.tree.map(lambda *x: sum(x), *dict(directions(problem, 0.3)).values())
    data, other = problem.data, made("conjugate gradients")
    _, expected, *_ = program("a point held")(data, u, u)
    values = minimum(problem, data)
    scalar = jax.jit(lambda d, u: jax.jvp(lambda d: scalar_of(other, values, d), (d,), (u,)))
    assert float(scalar(data, u)[1]) == pytest.approx(float(expected), rel=1e-9)
    own = [jax.jit(lambda d, p=p: precision(p, d).own["point"])(data) for p in (problem, other)]
    np.testing.assert_allclose(*own, atol=1e-14)


@pytest.mark.further
def test_gradient_of_a_gradient_in_a_batch():
    """Reverse over reverse, forward over reverse, both under vmap; one member has no solution."""
    problem = made("inner constraints")
    (name,) = problem.data.measured
    measured, weight = problem.data.measured[name], problem.data.weight[name]

    def scalar(measured, weight):
        data = dataclasses.replace(problem.data, measured={name: measured}, weight={name: weight})
        return jnp.sin(solve(problem, data)["point"]).sum()

    gradient = jax.grad(scalar)
    squared = lambda *x: jnp.sum(gradient(*x) ** 2)

    @jax.jit
    @jax.vmap
    def batch(*x):
        second, first = jax.jacfwd(lambda *x: (gradient(*x),) * 2, has_aux=True)(*x)
        return first, second, jax.grad(squared)(*x)

    step = 1e-3 * np.random.default_rng(6).normal(size=measured.shape)
    steps = jnp.stack([0 * step, step, -step, 2 * step, -2 * step, step])
    weights = jnp.stack([weight] * 5 + [weight.at[4:].set(0.0)])
    first, second, of_squared = (np.asarray(x) for x in batch(measured + steps, weights))
    differences = sum(factor * first[i] for i, (_, factor) in enumerate(STENCIL, 1))
    size = np.abs(second[0]).max()
    np.testing.assert_allclose(second[0], second[0].T, atol=1e-9 * size)
    np.testing.assert_allclose(second[0] @ step, differences, atol=1e-6 * size * 1e-3)
    np.testing.assert_allclose(of_squared[0], 2 * second[0] @ first[0], rtol=1e-8, atol=1e-9 * size)
    assert np.isnan(first[5, :4]).all() and np.isnan(second[5, :4, :4]).all()


# ---------------------------------------------------------------------- Gauss–Newton, precision


def dense(problem, values, data):
    """J of the free unknowns and the directions of the datum, G and B, at these values."""
    moved, zero, free = after(problem, values)
    J = jax.jit(jax.jacfwd(lambda x: residuals(problem, moved(x), data)))(zero)
    J = np.asarray(J)[:, free]
    if problem.plan.datum is None:
        return J, np.zeros((J.shape[1], 0))
    padded = complete_data(problem, dataclasses.replace(data, start=values)).start
    flat = lambda tree: np.concatenate([np.ravel(x) for x in jax.tree.leaves(tree)])

    @jax.jit
    def open_motions(values):
        gauge = keep_held_fixed(problem.declared, problem.plan, values).datum.gauge
        moves = of_groups(problem.plan, generators(problem.declared, values))
        return gauge, {g: x @ gauge for g, x in moves.items()}

    gauge, moves = open_motions(padded)
    G = np.stack([flat({g: x[..., k] for g, x in moves.items()}) for k in range(gauge.shape[1])], 1)
    zeros = zeros_of_tables(problem.declared, padded)
    weight = flat(of_groups(problem.plan, zeros | problem.plan.datum.weight))
    return J, (G * weight[:, None])[free]


def bordered(J, B):
    """Q of minimum Bᵀx = 0, and the answer to Bᵀx = c."""
    n, d = B.shape
    scale = np.abs(J.T @ J).max()
    whole = np.linalg.inv(np.block([[J.T @ J, scale * B], [scale * B.T, np.zeros((d, d))]]))
    return whole[:n, :n], whole[:n, n:] * scale


def test_precision_is_that_of_the_dense_inverse():
    """With a datum, and derivatives: tests/statistics/test_precision.py."""
    problem = made("photographs")
    data = problem.data
    chosen = lambda values: jnp.concatenate([values["point"][0], jnp.sin(values["point"][1])])
    found = jax.jit(lambda data: precision(problem, data, chosen, sigma0=2.0))(data)
    J, B = dense(problem, data.start, data)
    Q, _ = bordered(J, B)
    moved, zero, free = after(problem, data.start)
    both = jax.jit(jax.jacfwd(lambda x: (chosen(moved(x)), moved(x)["point"])))(zero)
    F, of_points = (np.asarray(x)[..., free] for x in both)
    C = 4 * F @ Q @ F.T
    np.testing.assert_allclose(found.covariance, C, atol=1e-8 * np.abs(C).max())
    own = 4 * np.einsum("nif,fg,njg->nij", of_points, Q, of_points)
    np.testing.assert_allclose(found.own["point"], own, atol=1e-8 * np.abs(own).max())


def test_gauss_newton_is_error_propagation_and_has_no_second_derivative():
    problem = made("a point held")
    data, solution = problem.data, minimum(problem, problem.data)
    (name,) = data.measured

    def points(measured, start, weight):
        start = data.start | {"point": start}
        own = {"measured": {name: measured}, "weight": {name: weight}, "start": start}
        given = dataclasses.replace(data, **own)
        given = complete_data(problem, given), "gauss-newton"
        moved = attach_derivatives(problem.declared, problem.plan, solution, *given)
        return (without_filling(problem, moved)["point"].ravel(),) * 2

    by_all = jax.jit(jax.jacfwd(points, (0, 1, 2), has_aux=True))
    by, value = by_all(data.measured[name], data.start["point"], data.weight[name])
    values = data.start | {"point": value.reshape(-1, 2)}
    values["device"] = solution["device"][:2]
    J, B = dense(problem, values, data)
    Q, into = bordered(J, B)
    free = np.flatnonzero(problem.tables[0].free)
    # ∂v/∂measured = −1/σ; the datum follows its start values. The first unknown is the device's.
    expected = (Q @ (J.T * np.asarray(data.weight[name]).T))[1:]
    by = [np.asarray(x) for x in by]
    np.testing.assert_allclose(by[0][free], expected, atol=1e-8 * np.abs(expected).max())
    expected, found = (into @ B.T)[1:, 1:], by[1].reshape(10, 10)[np.ix_(free, free)]
    np.testing.assert_allclose(found, expected, atol=1e-8 * np.abs(expected).max())
    # Twice the weight, P = w², not once.
    v, weight = (np.ravel(x) for x in (residuals(problem, values, data), data.weight[name]))
    expected = -2 * (Q @ J.T)[1:] * v / weight
    found = by[2].reshape(10, -1)[free]
    np.testing.assert_allclose(found, expected, atol=1e-8 * np.abs(expected).max())
    # It is not the exact one: they differ by the curvature.
    u, exact = jax.tree.map(np.zeros_like, jax.tree.map(np.asarray, data)), 0.0
    u.measured[name][0] = 0.2
    for step, factor in STENCIL:
        exact = exact + factor / 0.2 * minimum(problem, along(data, u, step))["point"][:5].ravel()
    apart = np.abs(exact - by[0][:, 0].ravel()).max() / np.abs(exact).max()
    assert 1e-5 < apart < 0.5  # a net of the plane, with residuals of 0.3 in 50
    with pytest.raises(InputError, match="first derivatives only"):
        given = data.start["point"], data.weight[name]
        jax.jacfwd(jax.grad(lambda m: points(m, *given)[0][0]))(data.measured[name])


def test_what_did_not_converge_is_nan_with_its_derivative():
    """√2 from 10, to the end and by a single step, which ends at a finite number."""
    square = Kind("square", lambda x, y: x**2 - y, of=("x",))
    problem = make_problem(
        [Table("x", np.array([10.0]))], [square((np.zeros(1, int),), np.array([2.0]), sigma=1.0)]
    )

    def root(y, steps):
        data = dataclasses.replace(problem.data, measured={"square": y})
        return solve(problem, data, max_iterations=steps)["x"][0]

    both = jax.value_and_grad(root)
    measured = problem.data.measured["square"]
    x, slope = both(measured, 100)
    np.testing.assert_allclose([x, *slope], [np.sqrt(2), 1 / np.sqrt(8)], rtol=1e-9)
    assert np.isnan(np.concatenate([np.ravel(a) for a in both(measured, 1)])).all()


def test_data_of_another_shape_are_refused():
    problem = made("inner constraints")
    cut = {name: measured[1:] for name, measured in problem.data.measured.items()}
    short = dataclasses.replace(problem.data, measured=cut)
    with pytest.raises(InputError, match=r"data\.measured.*expected .*as in problem.data, got"):
        solve(problem, short)


@pytest.mark.parametrize("rows", [3, 40], ids=["copied", "more copies than observations"])
def test_look_ups_of_accelerators_are_look_ups(rows):
    """In value and in reverse mode, which sums over all observations of a row."""
    random = np.random.default_rng(3)
    at = jnp.array(random.integers(rows, size=(30, 8)), jnp.int32)
    column, weight = jnp.array(random.normal(size=rows)), jnp.array(random.normal(size=at.shape))
    value, transposed = jax.vjp(lambda x: _look_up_in_copies((x,), at)[0], column)
    np.testing.assert_array_equal(value, look_up(column, at))
    sums = np.array([weight[at == row].sum() for row in range(rows)])
    np.testing.assert_allclose(transposed(weight)[0], sums, rtol=1e-14, atol=1e-14)
