"""Roots of equations as functions of their data, differentiable to any order.

By the implicit function theorem a root x(θ) of g(x, θ) = 0 moves with θ by

    ẋ = −(∂g/∂x)⁻¹·∂g/∂θ·θ̇,        everything at x(θ).

The root in this rule is again the function x(θ), and its linear system is differentiated by A·x = b
→ A·ẋ = ḃ − Ȧ·x. So the rule holds to any order in forward, reverse and mixed mode (Griewank and
Walther 2008, section 15.3). The iterations that found the root are never differentiated, nor is a
factorisation of A.
"""

# The functions of this module are defined by their derivative rules.
# ruff: noqa: ARG001

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree
from jaxtyping import PyTree

from jaxbundle.errors import InputError


@eqx.filter_custom_jvp
def implicit_root(
    equations: Callable, solve: Callable, root: PyTree, fixed: PyTree, data: PyTree
) -> PyTree:
    """`root` as a function of `data`, differentiable to any order.

    **Arguments:** `equations(x, fixed, data)`, zero at the root, in the form of x; `solve(times,
    fixed, b)`, the solution of A·x = b, where `times(x)` is A·x, A = ∂equations/∂x at the root;
    differentiable in b and in the dependencies of `times` (`solve_dense`,
    `jax.lax.custom_linear_solve`); `root` and `fixed` without derivatives (`stop_gradient`).
    """
    return root


@implicit_root.def_jvp
def _(primals: tuple[Any, ...], tangents: tuple[Any, ...]):
    equations, solve, root, fixed, data = primals
    root = implicit_root(*primals)
    at_root = lambda data: equations(root, fixed, data)
    change = derivative_along(at_root, data, tangents[-1])
    at_data = lambda x: equations(x, fixed, data)
    times = lambda x: jax.jvp(at_data, (root,), (x,))[1]
    return root, jax.tree.map(jnp.negative, solve(times, fixed, change))


def derivative_along(function: Callable, data: PyTree, change: PyTree) -> PyTree:
    """The derivative of a function along a change of its data, None if there is no change."""
    value, displaced = eqx.filter_jvp(function, (data,), (change,))
    return jax.tree.map(lambda x, d: jnp.zeros_like(x) if d is None else d, value, displaced)


def solve_dense(times: Callable, fixed: PyTree, b: PyTree) -> PyTree:
    """The solution of a small system A·x = b, by its matrix; NaN where A is singular."""
    flat, unravel = ravel_pytree(b)
    column = lambda e: ravel_pytree(times(unravel(e)))[0]
    A = jax.vmap(column, out_axes=1)(jnp.eye(flat.size, dtype=flat.dtype))
    return unravel(jnp.linalg.solve(A, flat))


@eqx.filter_custom_jvp
def differentiable_once(x: PyTree, message: str) -> PyTree:
    """`x`, for use in a derivative rule that must not be differentiated again.

    **Raises:** `InputError` with the message, where it is."""
    return x


@differentiable_once.def_jvp
def _(primals: tuple[Any, ...], tangents: tuple[Any, ...]):
    raise InputError(primals[1])
