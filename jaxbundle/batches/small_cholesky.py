"""Cholesky's method for many small systems at once, unrolled: N = L·Lᵀ, row by row.

Every element of a matrix is an array over all systems, so that the processor's vector unit works
on as many of them as it can hold; LAPACK takes them one at a time.

    Lᵢⱼ = (Nᵢⱼ − Σₖ Lᵢₖ·Lⱼₖ)/Lⱼⱼ,        Lᵢᵢ = √(Nᵢᵢ − Σₖ Lᵢₖ²),        k < j

Source: Golub and Van Loan (2013), Matrix Computations, section 4.2.
"""

from collections.abc import Sequence

import jax.numpy as jnp
from jax import Array
from jaxtyping import Float

# A matrix by rows, up to the diagonal where it is symmetrical or triangular.
Rows = list[list[Array]]


def rows_of(matrices: Float[Array, "systems n m"]) -> Rows:
    """The elements of matrices [systems, n, m] as rows of arrays [systems]."""
    return [[matrices[:, i, j] for j in range(matrices.shape[2])] for i in range(matrices.shape[1])]


def cholesky(N: Rows) -> Rows:
    """L, with the reciprocal of the diagonal in its place; NaN where N is not positive definite."""
    L: Rows = []
    for i, row in enumerate(N):
        new = []
        for j in range(i):
            new.append((row[j] - _dot(new, L[j][:j])) * L[j][j])
        # The reciprocal once, since a division takes as long as many products.
        new.append(1 / jnp.sqrt(row[i] - _dot(new, new)))
        L.append(new)
    return L


def forward(L: Rows, b: Sequence[Array]) -> list[Array]:
    """y of L·y = b; the elements of b may have further axes."""
    y = []
    for i, row in enumerate(L):
        y.append((b[i] - _dot(row[:i], y)) * row[i])
    return y


def backward(L: Rows, y: Sequence[Array]) -> list[Array]:
    """x of Lᵀ·x = y."""
    n, x = len(L), [*y]
    for i in reversed(range(n)):
        rows_below = range(i + 1, n)
        x[i] = (y[i] - _dot([L[j][i] for j in rows_below], [x[j] for j in rows_below])) * L[i][i]
    return x


def _dot(a: Sequence[Array], b: Sequence[Array]) -> Array | float:
    return sum((p * q for p, q in zip(a, b)), start=0.0)
