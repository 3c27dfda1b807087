r"""The inverse of a distortion formula, with exact derivatives of every order.

Given g(p, x, y) and a target (X, Y), find (x, y) with g(p, x, y) = (X, Y) by Newton's method:

    (x, y) ← (x, y) + J⁻¹·((X, Y) − g(p, x, y)),        J = ∂g/∂(x, y)

The iterations are not differentiated. By the implicit function theorem the root moves with

    (ẋ, ẏ) = J⁻¹·((Ẋ, Ẏ) − ∂g/∂p·ṗ),                  J taken at the root,

and since the root in that rule is again this function, its second derivatives are exact as well.

The number of iterations is fixed: Newton doubles the correct digits, and points do not wait for
one another. To be within 1e-12 of the half diagonal everywhere in the image, mapping cameras need 1
or 2 iterations, close-range and video cameras 3, an ordinary wide-angle lens 4, a fisheye 3 to 6,
and a fisheye whose polynomial is nearly flat at the edge 11: hence the default of 6, and higher
numbers in some models. In milliseconds of CPU for 200 000 points of `brown`, value / with both
gradients: this method 19 / 38; differentiating two Newton corrections at a frozen root 20 / 60;
differentiating all iterations 6 / 665. With the loop unrolled it would be 13 / 32, but for `usgs`
XLA's fusion then compiles for many minutes.

A target outside the range of g, for example beyond the radius where the distortion turns
(`validity.py`), has no root, or only one on a foreign branch. A wrong coordinate would enter an
adjustment unseen; NaN cannot. The root is accepted if the remainder is rounding and J has
a positive determinant and trace: at the principal point J is near the identity, and on the branch
that starts there its eigenvalues keep positive real parts.
"""

from collections.abc import Callable
from functools import partial

import jax
import jax.numpy as jnp

from jaxbundle.cameras.scalars import Formula, Pair, Parameters, Scalar


def implicit_inverse(g: Formula, start: Formula, iterations: int = 6) -> Formula:
    """The function (p, X, Y) -> (x, y) with g(p, x, y) = (X, Y), differentiable in all arguments.

    **Arguments:** `g`, near the identity but for a shift; `start`, `(p, X, Y) -> (x, y)`, undoes
    the shift and begins the `iterations`.

    **Returns:** a function whose result is NaN if no root was found.
    """

    @jax.custom_jvp
    def inverse(p: Parameters, X: Scalar, Y: Scalar) -> Pair:
        def newton(_: int, xy: Pair) -> Pair:
            (gx, gy), J = value_and_derivative(g, p, *xy)
            dx, dy = _solve(J, X - gx, Y - gy)
            return xy[0] + dx, xy[1] + dy

        # As many steps for every point: a loop that waits for the slowest of a million would wait
        # for those without a root.
        x, y = jax.lax.fori_loop(0, iterations, newton, start(p, X, Y))
        (gx, gy), (a, b, c, d) = value_and_derivative(g, p, x, y)
        # A thousand units of rounding: of p in the formula, amplified where J is nearly singular.
        remainder = jnp.abs(gx - X) + jnp.abs(gy - Y)
        size = jnp.abs(x) + jnp.abs(y) + jnp.abs(X) + jnp.abs(Y)
        is_root = remainder <= 1000 * jnp.finfo(jnp.result_type(x)).eps * size
        # On the branch through the principal point the Jacobian keeps eigenvalues of positive real
        # part.
        is_root &= (a * d - b * c > 0) & (a + d > 0)
        return jnp.where(is_root, x, jnp.nan), jnp.where(is_root, y, jnp.nan)

    @inverse.defjvp
    def _(primals: tuple, tangents: tuple) -> tuple[Pair, Pair]:
        (p, X, Y), (dp, dX, dY) = primals, tangents
        x, y = inverse(p, X, Y)
        _, J = value_and_derivative(g, p, x, y)
        # ẋ = J⁻¹·(Ẋ − ∂g/∂p·ṗ), at the root, which is `inverse` again: differentiable once more.
        _, (gx, gy) = jax.jvp(lambda p: g(p, x, y), (p,), (dp,))
        return (x, y), _solve(J, dX - gx, dY - gy)

    def with_floats(p: Parameters, X: Scalar, Y: Scalar) -> Pair:
        # Whole numbers have no derivatives: all become floats of one precision.
        dtype = jnp.result_type(float, *p, X, Y)
        *p, X, Y = (jnp.asarray(v, dtype) for v in (*p, X, Y))
        return inverse(tuple(p), X, Y)

    return with_floats


def limit_region(
    formula: Formula,
    region: Callable[[Parameters, Scalar, Scalar], Scalar],
    start: Formula,
    iterations: int,
) -> tuple[Formula, Formula]:
    """A formula and its inverse, NaN outside a region of (x, y).

    Newton's method goes by the formula without the limit: on its way to a point near the edge it
    may step across.
    """
    inverse = implicit_inverse(formula, start, iterations)

    def inside_only(p: Parameters, at: Pair, result: Pair) -> Pair:
        is_inside = region(p, *at)
        x, y = (jnp.where(is_inside, value, jnp.nan) for value in result)
        return x, y

    def inverse_inside_only(p: Parameters, X: Scalar, Y: Scalar) -> Pair:
        # The limit is applied to the root, not to the steps that lead to it.
        xy = inverse(p, X, Y)
        return inside_only(p, xy, xy)

    return lambda p, x, y: inside_only(p, (x, y), formula(p, x, y)), inverse_inside_only


def value_and_derivative(
    g: Formula, p: Parameters, x: Scalar, y: Scalar
) -> tuple[Pair, tuple[Scalar, Scalar, Scalar, Scalar]]:
    """g and its derivative J = [[a, b], [c, d]] with respect to (x, y)."""
    one, zero = jnp.ones_like(x), jnp.zeros_like(x)
    at_p = partial(g, p)
    # Two directions, each a column of J, with the value: cheaper than `jacfwd` of an array of two.
    value, (a, c) = jax.jvp(at_p, (x, y), (one, zero))
    _, (b, d) = jax.jvp(at_p, (x, y), (zero, one))
    return value, (a, b, c, d)


def _solve(J: tuple[Scalar, Scalar, Scalar, Scalar], u: Scalar, v: Scalar) -> Pair:
    """J⁻¹·(u, v)."""
    a, b, c, d = J
    determinant = a * d - b * c
    return (d * u - b * v) / determinant, (a * v - c * u) / determinant
