"""Stock solvers of optimistix with our elimination, and our solver with stock searches: one
minimum."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest
from test_reductions import line

from jaxbundle import leastsquares as ls
from jaxbundle.geometry import quaternion_from_rotation_vector
from jaxbundle.leastsquares.bridge import stock_problem, values_of
from jaxbundle.leastsquares.iterations.stopping import SETTLED
from jaxbundle.leastsquares.solution import find_minimum

POSES, POINTS, SIGMA = 3, 9, 1e-3


@pytest.fixture(scope="module")
def problem():
    """Points measured in the frames of poses; four points are held, a distance ties two."""
    random = np.random.default_rng(5)
    turn = lambda v: np.asarray(jax.vmap(quaternion_from_rotation_vector)(jnp.asarray(v)))
    turns, centre = random.normal(size=(POSES, 3)), random.normal(size=(POSES, 3))
    X, free = random.normal(size=(POINTS, 3)), np.arange(POINTS) > 3
    pose, point = (k.ravel() for k in np.indices((POSES, POINTS)))
    space, value = ls.Pose(), ls.PoseValue(jnp.asarray(centre), jnp.asarray(turn(turns)))
    ray = lambda value, X: jnp.stack(space.prepare(value).ray(X))
    seen = jax.vmap(ray)(jax.tree.map(lambda x: x[pose], value), jnp.asarray(X[point]))
    seen = np.asarray(seen) + SIGMA * random.normal(size=(len(pose), 3))
    near = lambda x: x + 0.1 * random.normal(size=x.shape)
    start = ls.PoseValue(near(centre), turn(near(turns)))
    place = ls.Kind("place", lambda pose, X, x: jnp.stack(pose.ray(X)) - x, of=("pose", "point"))
    length = ls.Kind(
        "length", lambda a, b, d: jnp.linalg.norm(a - b) - d, of=("point", "point")
    )
    some = np.where(free[:, None], near(X), X)
    return ls.make_problem(
        [ls.Table("pose", start), ls.Table("point", some, free=free)],
        [place((pose, point), seen, sigma=SIGMA),
         length(([5], [6]), np.linalg.norm(X[[5]] - X[[6]], axis=1), sigma=SIGMA)],
        "point",
    )  # fmt: skip


@pytest.fixture(scope="module")
def minimum(problem):
    found = find_minimum(problem, atol=1e-8)
    assert int(found.termination) == SETTLED
    return found.values


def assert_same(values, minimum):
    for a, b in zip(jax.tree.leaves(values), jax.tree.leaves(minimum), strict=True):
        np.testing.assert_allclose(a, b, atol=1e-8)


@pytest.mark.further
def test_stock_solver_reaches_our_minimum(problem, minimum):
    fn, y0, linear = stock_problem(problem)
    solver = optx.LevenbergMarquardt(1e-10, 1e-10, linear_solver=linear)
    run = eqx.filter_jit(lambda data: optx.least_squares(fn, solver, y0, args=data).value)
    assert_same(values_of(problem, run(problem.data)), minimum)


def test_an_open_datum_is_refused():
    with pytest.raises(ValueError, match="no datum"):
        stock_problem(line(10, held=False)[0])


@pytest.mark.parametrize("search", [optx.ClassicalTrustRegion(), optx.LearningRate(1.0)])
def test_stock_searches_reach_our_minimum(problem, minimum, search):
    # A rate of 1 is a damping that stays until a step is small: many steps.
    found = find_minimum(problem, search=search, max_steps=1000)
    assert int(found.termination) == SETTLED
    assert_same(found.values, minimum)
