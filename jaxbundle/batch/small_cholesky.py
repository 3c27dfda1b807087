"""Cholesky's method for many small systems at once, unrolled: N = L·Lᵀ, row by row.

Every element of a matrix is an array over all systems, so that the processor's vector unit works
on as many of them as it can hold; LAPACK takes them one at a time.

Source: Golub and Van Loan (2013), Matrix Computations, section 4.2.
"""

import jax.numpy as jnp

Rows = list[list]


def rows_of(matrices) -> Rows:
    """The elements of matrices [systems, n, m] as rows of arrays [systems]."""
    return [[matrices[:, i, j] for j in range(matrices.shape[2])] for i in range(matrices.shape[1])]


def cholesky(N: Rows) -> Rows:
    """L, with the reciprocal of the diagonal in its place; NaN where N is not positive definite."""
    L = []
    for i, row in enumerate(N):
        found = []
        for j in range(i):
            found.append((row[j] - _dot(found, L[j][:j])) * L[j][j])
        found.append(1 / jnp.sqrt(row[i] - _dot(found, found)))
        L.append(found)
    return L


def forward(L: Rows, b: list) -> list:
    """y of L·y = b; the elements of b may have further axes."""
    y = []
    for i, row in enumerate(L):
        y.append((b[i] - _dot(row[:i], y)) * row[i])
    return y


def backward(L: Rows, y: list) -> list:
    """x of Lᵀ·x = y."""
    n, x = len(L), [None] * len(L)
    for i in reversed(range(n)):
        below = range(i + 1, n)
        x[i] = (y[i] - _dot([L[j][i] for j in below], [x[j] for j in below])) * L[i][i]
    return x


def _dot(a, b):
    return sum((p * q for p, q in zip(a, b)), start=0.0)
