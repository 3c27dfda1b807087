"""The Cholesky factor of a symmetric matrix of which only the lower triangle is given.

With S = L·Lᵀ, Φ the lower triangle with half of the diagonal (Smith 1995; Murray 2016),

    L̇ = L·Φ(L⁻¹·Ṡ·L⁻ᵀ)

where Ṡ, too, is given by its lower triangle: JAX's own rule takes it for the whole.
"""

import jax
import jax.numpy as jnp
from jax.scipy.linalg import solve_triangular
from jaxtyping import Array, Float


@jax.custom_jvp
def cholesky_of_lower(S: Float[Array, "*batch n n"]) -> Float[Array, "*batch n n"]:
    """L of S = L·Lᵀ from the lower triangle of S; NaN where it is not positive definite."""
    return jnp.linalg.cholesky(S, symmetrize_input=False)


@cholesky_of_lower.defjvp
def _(primals, tangents):
    (S,), (change,) = primals, tangents
    L = cholesky_of_lower(S)
    below = jnp.tril(change, -1)
    change = jnp.tril(change) + below.mT
    half = solve_triangular(L, change, lower=True)
    inner = solve_triangular(L, half.mT, lower=True)
    return L, L @ (jnp.tril(inner) - 0.5 * inner * jnp.eye(S.shape[-1]))
