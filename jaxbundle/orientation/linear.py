"""Linear algebra of start values: null vectors, normalised coordinates, the extent of points.

A homogeneous system A·h ≈ 0, |h| = 1, is solved by the right singular vector of the least singular
value. Its derivatives, of every order, also where that value is zero, are those of the root of

    (AᵀA − λ·I)·h = 0,   hᵀh = 1                            (Golub and Pereyra, 1973)
"""

import jax.numpy as jnp
from jax import Array
from jax.lax import stop_gradient
from jaxtyping import Bool, Float

from jaxbundle.implicit import implicit_root, solve_dense
from jaxbundle.types import AnyArray

# Singular values below this part of the largest count as zero: points lie on a line or in a plane,
# or linear equations leave a parameter open. It lies between rounding and noise: rounding is 1e-16
# of a coordinate, so 1e-10 of the extent of points a million extents from the origin (map
# coordinates); measurements of images are good to 1e-6 of the format at best, which spreads even
# the points of a line by more. So it finds degenerate configurations of exact data; of measured
# data the cofactors show them.
RANK_TOLERANCE = 1e-7


def null_vector(
    A: Float[AnyArray, "rows n"],
) -> tuple[Float[Array, " n"], Float[Array, " n"]]:
    """h of least |A·h|, |h| = 1, and the singular values, largest first; zero if rows are few."""
    s, Vt = _right_singular(stop_gradient(A))
    root = (Vt[-1], s[-1] ** 2)
    # The derivatives of an SVD divide by singular values, of which the last is zero for exact data;
    # those of the root need only that it is a single one.
    return implicit_root(_null_equations, solve_dense, root, None, A)[0], s


def _null_equations(
    root: tuple[Float[Array, " n"], Float[Array, ""]], _: None, A: Float[AnyArray, "rows n"]
) -> tuple[Float[AnyArray, " n"], Float[Array, ""]]:
    h, eigenvalue = root
    return A.T @ (A @ h) - eigenvalue * h, 0.5 * (h @ h - 1)


def null_space(A: Float[AnyArray, "rows n"], k: int) -> Float[Array, "k n"]:
    """The k right singular vectors of the least singular values, without derivative."""
    return _right_singular(stop_gradient(A))[1][-k:]


def normalisation(
    points: Float[AnyArray, "n d"], weights: Float[AnyArray, " n"]
) -> tuple[Float[Array, " d"], Float[Array, ""]]:
    """Weighted mean, and the root mean square of a coordinate about it (Hartley, 1997)."""
    total = jnp.sum(weights)
    mean = jnp.asarray(weights) @ points / total
    square = weights @ jnp.sum((points - mean) ** 2, 1) / (total * points.shape[1])
    return mean, jnp.sqrt(jnp.where(square > 0, square, 1.0))


def extent(points: Float[AnyArray, "n d"], weights: Float[AnyArray, " n"]) -> Float[Array, " d"]:
    """Extents along the principal axes relative to the largest: (1, 0, 0) of points on a line."""
    mean, _ = normalisation(points, weights)
    rows = stop_gradient(jnp.sqrt(weights)[:, None] * (points - mean))
    s, _ = _right_singular(rows)
    return s / jnp.where(s[0] > 0, s[0], 1)


def are_collinear(
    points: Float[AnyArray, "n d"], weights: Float[AnyArray, " n"]
) -> Bool[Array, ""]:
    """Whether the points of weight > 0 lie on a line, or are one."""
    return extent(points, weights)[1] < RANK_TOLERANCE


def ones_unless(weights: Float[AnyArray, " n"] | None, points: AnyArray) -> Float[Array, " n"]:
    """The weights, one a point if there are none."""
    ones = jnp.ones(points.shape[0], points.dtype)
    return ones if weights is None else jnp.asarray(weights)


def _right_singular(
    A: Float[AnyArray, "rows n"],
) -> tuple[Float[Array, " n"], Float[Array, "n n"]]:
    """Singular values and all right singular vectors: empty rows are added to a flat matrix."""
    empty_rows = max(A.shape[1] - A.shape[0], 0)
    _, s, Vt = jnp.linalg.svd(jnp.pad(A, ((0, empty_rows), (0, 0))), full_matrices=False)
    return s, Vt
