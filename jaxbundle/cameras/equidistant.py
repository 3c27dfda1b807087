"""The equidistant image of a ray, the ideal one of a fisheye.

    xi = fx·θ·cos ψ,  yi = fy·θ·sin ψ          θ the angle to the optical axis, ψ the azimuth

Written in even functions (below) it is also smooth on the optical axis, and it is valid beyond
θ = 90°, where q > 0. Only straight backwards, at θ = 180°, a ray has no azimuth and so no image.
"""

from collections.abc import Sequence

import jax.numpy as jnp

from jaxbundle.cameras.scalars import OfRay, Pair, Parameters, Scalar, ToRay, Triple


def equidistant(columns: Sequence[int], up: bool) -> tuple[OfRay, ToRay]:
    """The ideal image of a ray, and the ray of an ideal image, NaN beyond θ = 180°.

    **Arguments:** as of `perspective.perspective`.
    """
    first, last = columns[0], columns[-1]

    def ideal(p: Parameters, r: Scalar, s: Scalar, q: Scalar) -> Pair:
        scale = angle_over_sine(r * r + s * s, q)
        return p[first] * scale * r, p[last] * scale * s if up else -p[last] * scale * s

    def ray(p: Parameters, xi: Scalar, yi: Scalar) -> Triple:
        X, Y = xi / p[first], yi / p[last]
        square = X * X + Y * Y
        square = jnp.where(square < jnp.pi**2, square, jnp.nan)
        scale = sine_over_angle(square)
        return scale * X, scale * Y if up else -scale * Y, -cosine(square)

    return ideal, ray


# The three functions below are even in the angle, so they are smooth in its square, but √ is not at
# 0: near 0 a series replaces them, exact to rounding. The inner `where` keeps the derivative of the
# branch not taken finite.

# Below this the first omitted term of the longest series, t¹⁰/11, is 9e-17, less than rounding; of
# the others less still.
_NEAR = 1e-3


def angle_over_sine(square: Scalar, q: Scalar) -> Scalar:
    """θ/ρ with ρ² = `square` = r² + s² and θ = atan2(ρ, −q)."""
    # Not near θ = 180°, where the ray has no azimuth and the image none: there the quotient is
    # right, infinite.
    near = (square < _NEAR * q * q) & (q < 0)
    t2 = jnp.where(near, square / jnp.where(near, q * q, 1.0), 0.0)
    series = (1 - t2 * (1 / 3 - t2 * (1 / 5 - t2 * (1 / 7 - t2 / 9)))) / jnp.where(near, -q, 1.0)
    rho = jnp.sqrt(jnp.where(near, 1.0, square))
    return jnp.where(near, series, jnp.arctan2(rho, -q) / rho)


def sine_over_angle(square: Scalar) -> Scalar:
    """sin θ/θ with θ² = `square`."""
    near = square < _NEAR
    t2 = jnp.where(near, square, 0.0)
    theta = jnp.sqrt(jnp.where(near, 1.0, square))
    return jnp.where(near, 1 - t2 / 6 * (1 - t2 / 20 * (1 - t2 / 42)), jnp.sin(theta) / theta)


def cosine(square: Scalar) -> Scalar:
    """cos θ with θ² = `square`."""
    near = square < _NEAR
    t2 = jnp.where(near, square, 0.0)
    theta = jnp.sqrt(jnp.where(near, 1.0, square))
    series = 1 - t2 / 2 * (1 - t2 / 12 * (1 - t2 / 30 * (1 - t2 / 56)))
    return jnp.where(near, series, jnp.cos(theta))
