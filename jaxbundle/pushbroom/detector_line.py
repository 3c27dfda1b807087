"""Whether the detector line has passed over a point.

    F = −s/q − η(ξ),    ξ = −r/q,    [r, s, q] = M·D + m,

the slope of a sight D ahead of the detectors, with η a polynomial of ξ: zero where the line sees
the point, of one sign before and of the other after it.
"""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxbundle.geometry.vectors import Vector
from jaxbundle.pushbroom.polynomial import value
from jaxbundle.pushbroom.scanner import Optics
from jaxbundle.system.programs import compile_once
from jaxbundle.types import AnyArray, Scalar

slopes = compile_once(lambda optics, u: optics.slopes(u), ())


def fit_line(optics: Optics, pixels: int) -> Float[Array, "6"]:
    """Coefficients of η as a polynomial of ξ.

    Degree 5 follows smile and distortion well enough for approximate times; Newton's method uses
    the optics themselves.
    """
    u = np.linspace(0, max(pixels - 1, 1), 257)
    xi, eta = (np.asarray(v) for v in slopes(optics, u))
    return jnp.asarray(np.polynomial.polynomial.polyfit(xi, eta, 5))


def slope_ahead(
    numbers: Float[AnyArray, "12 ..."], D: Vector, line: Float[AnyArray, "6"]
) -> tuple[Scalar, Scalar]:
    """(F, ξ) of a sight D from the origin of the pieces; NaN behind the camera."""
    r, s, q = (sum(numbers[3 * i + k] * D[k] for k in range(3)) + numbers[9 + i] for i in range(3))
    front = q < 0
    # A divisor for the branch that is not chosen: NaN there would spread to derivatives.
    q = jnp.where(front, q, -1.0)
    xi = -r / q
    return jnp.where(front, -s / q - value(line, xi), jnp.nan), xi
