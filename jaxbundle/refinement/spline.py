"""Jitter: a uniform cubic B-spline of the attitude without constant and linear part.

    s(t) = Σ c_k·b((t − t_first)/h − (k − 1)),      b(x) = ⅔ − x² + |x|³/2          |x| < 1
                                                    b(x) = (2 − |x|)³/6         1 ≤ |x| < 2

(de Boor, 1978, chapter IX). The coefficients 1, 1, 1, … give a constant and 0, 1, 2, … a straight
line, which are already the unknowns bias and drift. So c = Z·z, the columns of Z an orthonormal
basis of the orthogonal complement: two unknowns fewer per axis, without duplicates. Independent c
of equal σ give independent z with the same σ.
"""

import dataclasses

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxbundle.types import AnyArray, Scalar

# Smallest number of intervals between knots. Three have six coefficients, less two for constant and
# line; one or two are little more than a single cubic polynomial.
MIN_INTERVALS = 3


@dataclasses.dataclass(frozen=True)
class JitterSpline:
    """Knots every `spacing` seconds from `first` on, `intervals` between them; 0: no spline."""

    first: float
    spacing: float
    intervals: int

    @property
    def coefficients(self) -> int:
        """The number of the c of an axis."""
        return self.intervals + 3 if self.intervals else 0

    @property
    def unknowns(self) -> int:
        """The number of the z of an axis."""
        return max(self.coefficients - 2, 0)

    @property
    def centres(self) -> Float[np.ndarray, " coefficients"]:
        """The time where each coefficient acts most, seconds."""
        return self.first + self.spacing * (np.arange(self.coefficients) - 1)

    @property
    def basis(self) -> Float[np.ndarray, "coefficients unknowns"]:
        """Z."""
        k = np.arange(self.coefficients)
        # The columns of Q behind those that span constant and line.
        full = np.linalg.qr(np.stack([np.ones_like(k), k], 1).astype(float), mode="complete")[0]
        return full[:, 2:]

    def evaluate(self, z: Float[AnyArray, "3 k"], t: Scalar) -> Float[Array, "3"]:
        """s(t) of three axes; z may have more columns than there are unknowns."""
        return jnp.asarray(z)[:, : self.unknowns] @ self.weights(t)

    def weights(self, t: Scalar) -> Float[Array, " unknowns"]:
        """The coefficient of every z in s(t)."""
        if not self.intervals:
            return jnp.zeros(0)
        x = jnp.abs((t - self.centres) / self.spacing)
        # All coefficients, as b is 0 beyond 2: they are few, and no index depends on the time.
        inner_part = 2 / 3 - x**2 + x**3 / 2
        outer_part = jnp.maximum(2 - x, 0.0) ** 3 / 6
        return jnp.asarray(self.basis.T) @ jnp.where(x < 1, inner_part, outer_part)


def make_spline(begin: float, end: float, spacing: float) -> JitterSpline:
    """The spline over a span of time with knots at most `spacing` seconds apart."""
    # Less 1e-9, or rounding would make four intervals of three.
    intervals = max(int(np.ceil((end - begin) / spacing - 1e-9)), MIN_INTERVALS)
    return JitterSpline(float(begin), float((end - begin) / intervals), intervals)


NO_SPLINE = JitterSpline(0.0, 1.0, 0)
