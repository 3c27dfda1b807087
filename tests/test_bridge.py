"""The stock solvers of optimistix with our linear algebra reach our minimum."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest
from jaxbundle.adjustment.bridge import SchurLinearSolver, stock_problem, values_of

import jaxbundle
from jaxbundle.adjustment.solve import find_minimum, make_solver

pytestmark = pytest.mark.xdist_group("bridge")


@pytest.fixture(scope="module")
def problem():
    """Six images, control points with σ, two distances that share a point, a prior on c."""
    stations = jaxbundle.ring_of_stations(6, 5.0, 2.0, roll_every=2)
    axis = np.linspace(-1, 1, 3)
    targets = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), -1).reshape(-1, 3)
    camera = jaxbundle.Camera(
        "cam", "brown", {"c": 20.0, "K1": 1e-4}, free=("c", "K1"), sigma={"c": 0.05}
    )
    network = jaxbundle.simulate(
        stations, targets, camera, noise=0.002, seed=2, datum="control", control=(0, 8, 20, 26),
        control_sigma=0.001, distances=((1, 5), (5, 7)), distance_sigma=0.001, disturb=0.005,
    )  # fmt: skip
    return jaxbundle.make_problem(jaxbundle.check_network(network))


@pytest.fixture(scope="module")
def minimum(problem):
    return find_minimum(make_solver(problem), problem.data).values


@pytest.mark.parametrize(
    "stock",
    [
        lambda linear: optx.LevenbergMarquardt(1e-10, 1e-10, linear_solver=linear),
        lambda linear: optx.GaussNewton(1e-10, 1e-10, linear_solver=linear),
    ],
    ids=["levenberg-marquardt", "gauss-newton"],
)
def test_stock_solver_reaches_our_minimum(problem, minimum, stock):
    fn, y0, linear = stock_problem(problem)
    assert isinstance(linear, SchurLinearSolver)
    run = eqx.filter_jit(
        lambda data: optx.least_squares(fn, stock(linear), y0, args=data, max_steps=100).value
    )
    values = values_of(problem, run(problem.data))
    np.testing.assert_allclose(values.point, minimum.point, atol=1e-8)
    np.testing.assert_allclose(values.position, minimum.position, atol=1e-8)
    np.testing.assert_allclose(values.camera, minimum.camera, rtol=1e-7, atol=1e-12)


def test_a_free_network_is_refused(problem):
    floating = jaxbundle.make_problem(
        jaxbundle.check_network(
            jaxbundle.simulate(
                jaxbundle.ring_of_stations(3, 5.0, 2.0),
                np.asarray(problem.data.start.point)[:9],
                jaxbundle.Camera("cam", "brown", {"c": 20.0}),
                noise=0.002,
            )
        )
    )
    with pytest.raises(ValueError, match="no datum"):
        stock_problem(floating)


def test_adjustment_needs_64_bits():
    from jaxbundle.adjustment import require_x64

    jax.config.update("jax_enable_x64", False)
    try:
        with pytest.raises(RuntimeError, match="enable_x64"):
            require_x64()
    finally:
        jax.config.update("jax_enable_x64", True)
    assert jnp.zeros(1).dtype == jnp.float64
