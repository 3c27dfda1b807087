"""Roots with derivatives of every order, in every mode, against a root known in closed form."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxbundle.errors import InputError
from jaxbundle.implicit import differentiable_once, implicit_root, solve_dense
from jaxbundle.leastsquares.equations.reduced import cholesky_of_lower


def misclosure(x, fixed, data):
    """x₀³ = a and x₀ + x₁³ = b."""
    a, b = data
    return jnp.stack([x[0] ** 3 - fixed * a, x[0] + x[1] ** 3 - fixed * b])


def exact(data):
    x = jnp.cbrt(data[0])
    return jnp.stack([x, jnp.cbrt(data[1] - x)])


def found(data):
    root = jax.lax.stop_gradient(exact(data))
    return implicit_root(misclosure, solve_dense, root, jnp.asarray(1.0), data)


FORWARD, REVERSE = jax.jacfwd, jax.jacrev


@pytest.mark.parametrize("modes", [
    (FORWARD, FORWARD, FORWARD), (REVERSE, REVERSE, REVERSE), (FORWARD, REVERSE, FORWARD),
    (REVERSE, FORWARD, REVERSE),
])  # fmt: skip
def test_three_orders_in_every_mode(modes):
    """Every mode over every other."""

    def orders(function, modes):
        for mode in modes:
            function = mode(function)
            yield function

    def both(data):
        of_root, of_formula = orders(found, modes), orders(exact, (FORWARD,) * 3)
        return [f(data) for f in of_root], [f(data) for f in of_formula]

    for of_root, of_formula in zip(*jax.jit(both)(jnp.array([2.0, 7.0]))):
        np.testing.assert_allclose(of_root, of_formula, rtol=1e-10)


def test_under_vmap_and_jit():
    data = jnp.array([[2.0, 7.0], [3.0, 5.0]])
    by = lambda f: jax.jit(jax.vmap(jax.hessian(f)))(data)
    np.testing.assert_allclose(by(found), by(exact), rtol=1e-10)


def test_what_is_differentiable_once_says_so():
    once = jax.custom_jvp(lambda x: x)
    once.defjvp(lambda p, t: (p[0], t[0] * differentiable_once(p[0], "first derivatives only")))
    assert jax.grad(once)(2.0) == 2.0
    with pytest.raises(InputError, match="first derivatives only"):
        jax.grad(jax.grad(once))(2.0)


def test_cholesky_of_a_lower_triangle_by_what_is_in_it():
    S = jnp.array([[4.0, 0, 0], [1, 3, 0], [0.5, -1, 2]])
    whole = lambda S: jnp.linalg.cholesky(jnp.tril(S) + jnp.tril(S, -1).T)
    orders = (lambda f: f, jax.jacfwd, jax.jacrev, jax.hessian)
    found, expected = jax.jit(
        lambda S: [[order(f)(S) for order in orders] for f in (cholesky_of_lower, whole)]
    )(S)
    for a, b in zip(found, expected):
        np.testing.assert_allclose(a, b, rtol=1e-12, atol=1e-13)
