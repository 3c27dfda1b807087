"""Uniform cubic B-splines: the basis, and the spline through given values.

    B(t) = (4 − 6t² + 3|t|³)/6 for |t| < 1,  (2 − |t|)³/6 for |t| < 2,  else 0

Source: de Boor (1978), A Practical Guide to Splines, chapters 4 and 9.
"""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxbundle.cameras.scalars import Scalar


def basis(t: Scalar, first_knot: int, number: int) -> Float[Array, "*points knots"]:
    """B(t − j) of the knots j = first, first + 1, … as a last axis."""
    t = jnp.asarray(t)[..., None] - jnp.arange(first_knot, first_knot + number)
    a = jnp.abs(t)
    inner = (4 + t * t * (3 * a - 6)) / 6
    return jnp.where(a < 1, inner, jnp.maximum(2 - a, 0.0) ** 3 / 6)


def through_values(number: int) -> Float[np.ndarray, "knots number"]:
    """The coefficients of the knots −1 … number of natural splines (without curvature at the ends)
    through the values at 0 … number − 1, as a matrix of the values."""
    knots = number + 2
    A = np.zeros((knots, knots))
    for i in range(number):
        A[i, i : i + 3] = 1 / 6, 4 / 6, 1 / 6
    # Second differences of the first and last three coefficients: the curvature at both ends is 0.
    A[number, :3] = A[number + 1, -3:] = 1, -2, 1
    return np.linalg.inv(A)[:, :number]
