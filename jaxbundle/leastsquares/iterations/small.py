"""Dense least squares with few unknowns on a manifold: start values, refined closed forms.

    v(x) → vᵀv = min,        x ← x ⊞ δ,        (N + λ·diag N)·δ = −Jᵀv,        N = JᵀJ

J = ∂v(x ⊞ δ)/∂δ at δ = 0 by forward differentiation; v contains the roots of the weights. Steps and
stopping follow the engine's rules (`loop.py`). The iterations are not differentiated: the
derivatives, to any order, are those of the root of ∂(vᵀv)/∂δ = 0 (`jaxbundle.implicit`), curvature
of v included.
"""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import Array
from jax.lax import stop_gradient
from jax.scipy.linalg import cho_factor, cho_solve
from jaxtyping import Bool, Float, PyTree

from jaxbundle.implicit import implicit_root, solve_dense
from jaxbundle.leastsquares.iterations.loop import iterate
from jaxbundle.leastsquares.iterations.stopping import Tolerance

# Smallest eigenvalue of the normal matrix scaled to a unit diagonal for a solvable problem: some
# combination of unknowns changes the residuals 1e-5 times as much as one of them alone. Rounding
# leaves 1e-15, so that a thousand times less would still be found; but start values so weak lead to
# no adjustment.
SMALLEST_EIGENVALUE = 1e-10


class Fit(eqx.Module):
    """An adjusted estimate, its vᵀPv, and Q = N⁻¹ in the order of δ (infinite: undetermined).

    `weakest`: least eigenvalue of N scaled to a unit diagonal, 1 for uncorrelated unknowns.
    """

    estimate: PyTree
    vtpv: Float[Array, ""]
    cofactor: Float[Array, "u u"]
    weakest: Float[Array, ""]

    @property
    def determined(self) -> Bool[Array, ""]:
        return self.weakest > SMALLEST_EIGENVALUE


def adjust(
    residuals: Callable,
    retract: Callable,
    start: PyTree[Float[Array, "..."]],
    data: tuple,
    unknowns: int,
    steps: int = 30,
) -> Fit:
    """`minimise`, then `finish`: from start values to a differentiable `Fit`."""
    estimate, _ = minimise(residuals, retract, start, data, unknowns, steps)
    return finish(residuals, retract, estimate, data, unknowns)


def minimise(
    residuals: Callable,
    retract: Callable,
    start: PyTree[Float[Array, "..."]],
    data: tuple,
    unknowns: int,
    steps: int = 30,
) -> tuple[PyTree[Float[Array, "..."]], Float[Array, ""]]:
    """The estimate at the end of the iterations, and its vᵀv (infinite where it cannot be
    computed), without derivatives.

    **Arguments:** `residuals(x, *data)` [n], `retract(x, δ)`; `start`: initial x; `steps`: maximum
    evaluations. Starts are those of closed forms, a few steps away; a hopeless one is given up
    at 30, because under `vmap` all others wait for it.
    """
    start, data = stop_gradient((start, data))

    def linearise(x: PyTree[Float[Array, "..."]]) -> tuple[tuple, Float[Array, ""]]:
        N, g, v = _linearise(residuals, retract, x, data, unknowns)
        # NaN as cost lets the trust region reject the step.
        is_finite = jnp.isfinite(N).all() & jnp.isfinite(g).all()
        return (N, g, jnp.asarray(len(v))), 0.5 * jnp.where(is_finite, jnp.sum(v**2), jnp.nan)

    def step(
        equations: tuple, damping: Float[Array, ""]
    ) -> tuple[Float[Array, " u"], Float[Array, ""], Float[Array, ""]]:
        N, g, _ = equations
        D = jnp.diag(N)
        # An unknown without observations: any damping will do.
        D = jnp.where(D > 0, D, 1.0)
        change = -_solve(N + damping * jnp.diag(D), g)
        return change, -g @ change, D @ change**2

    def tolerance(equations: tuple) -> Tolerance:
        # The last step moves no unknown by more than 1e-8 of its σ; `finish` takes one more.
        # tr N for Σ(l/σ)², which is not known here: the squares by which unknowns change v that
        # change by 1, alike where unknowns and measured values are of the order of 1.
        N, _, rows = equations
        zero = jnp.zeros((), N.dtype)
        return Tolerance(rows - unknowns + zero, jnp.trace(N), zero + 1e-8, zero)

    loop = iterate(linearise, step, retract, start, tolerance, steps)
    return loop.at, jnp.where(jnp.isfinite(loop.cost), 2 * loop.cost, jnp.inf)


def finish(
    residuals: Callable,
    retract: Callable,
    estimate: PyTree[Float[Array, "..."]],
    data: tuple,
    unknowns: int,
) -> Fit:
    """The last step, without damping, the derivatives and the cofactors."""
    x, constant_data = stop_gradient((estimate, data))
    N, g = normal_equations(residuals, retract, x, constant_data, unknowns)
    diagonal = jnp.diag(N)
    scale = 1 / jnp.sqrt(jnp.where(diagonal > 0, diagonal, 1))
    scaled = N * scale * scale[:, None]
    weakest = jnp.linalg.eigvalsh(jnp.where(jnp.isfinite(scaled), scaled, 0))[0]
    determined = weakest > SMALLEST_EIGENVALUE
    # The inverse of a singular N is NaN, and so would be its derivatives, selected or not.
    N = jnp.where(determined, N, jnp.eye(unknowns, dtype=N.dtype))
    step = jnp.where(determined, -_solve(N, g), 0)
    square = lambda x, data: jnp.sum(residuals(x, *data) ** 2)
    # At the minimum, rounding may let vᵀv rise; far from it, an undamped step may be wrong.
    # (1e-11)²·tr N: where v vanishes, what unknowns that change by 1e-11 each leave of it.
    rounding = 1e-22 * jnp.sum(diagonal)
    good = square(retract(x, step), constant_data) <= 1.001 * square(x, constant_data) + rounding
    x = retract(x, jnp.where(good, step, 0))
    zero_change = jnp.zeros(unknowns, step.dtype)
    fixed = (residuals, retract, x)
    # The step here is zero; it carries the derivatives of the minimum with respect to the data.
    x = retract(x, implicit_root(_half_gradient, solve_dense, zero_change, fixed, data))
    N, _ = normal_equations(residuals, retract, x, data, unknowns)
    N = jnp.where(determined, N, jnp.eye(unknowns, dtype=N.dtype))
    cofactor = jnp.where(determined, inverse(N), jnp.inf)
    return Fit(x, square(x, data), cofactor, weakest)


def _half_gradient(delta: Float[Array, " u"], fixed: tuple, data: tuple) -> Float[Array, " u"]:
    """∂(½vᵀv)/∂δ after a step δ from the estimate."""
    residuals, retract, x = fixed
    return jax.grad(lambda delta: 0.5 * jnp.sum(residuals(retract(x, delta), *data) ** 2))(delta)


def normal_equations(
    residuals: Callable,
    retract: Callable,
    x: PyTree[Float[Array, "..."]],
    data: tuple,
    unknowns: int,
) -> tuple[Float[Array, "u u"], Float[Array, " u"]]:
    """N = JᵀJ and Jᵀv at x."""
    return _linearise(residuals, retract, x, data, unknowns)[:2]


def _linearise(
    residuals: Callable,
    retract: Callable,
    x: PyTree[Float[Array, "..."]],
    data: tuple,
    unknowns: int,
) -> tuple[Float[Array, "u u"], Float[Array, " u"], Float[Array, " n"]]:
    """N = JᵀJ, Jᵀv and v at x."""

    # `has_aux` returns v beside J: one evaluation instead of two.
    def twice(delta: Float[Array, " u"]) -> tuple[Float[Array, " n"], Float[Array, " n"]]:
        v = residuals(retract(x, delta), *data)
        return v, v

    zero = jnp.zeros(unknowns, jax.tree.leaves(x)[0].dtype)
    J, v = jax.jacfwd(twice, has_aux=True)(zero)
    return J.T @ J, J.T @ v, v


def inverse(N: Float[Array, "u u"]) -> Float[Array, "u u"]:
    """N⁻¹ of a positive definite N; else not finite."""
    return _solve(N, jnp.eye(N.shape[0], dtype=N.dtype))


def _solve(N: Float[Array, "u u"], g: Float[Array, "u *k"]) -> Float[Array, "u *k"]:
    """N⁻¹·g with N scaled to a unit diagonal; not finite if N is not positive definite."""
    diagonal = jnp.diag(N)
    scale = 1 / jnp.sqrt(jnp.where(diagonal > 0, diagonal, 1))
    column = scale if g.ndim == 1 else scale[:, None]
    return column * cho_solve(cho_factor(N * scale * scale[:, None]), column * g)
