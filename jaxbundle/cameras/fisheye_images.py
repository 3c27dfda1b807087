"""The four ideal images of fisheyes.

    equidistant     u = θ              equal angles; rays to 180°, which have no image
    stereographic   u = 2·tan(θ/2)     conformal; rays to 180°, which have no image
    equisolid       u = 2·sin(θ/2)     equal areas; rays to 180°, on the circle u = 2
    orthographic    u = sin θ          rays to 90°, on the circle u = 1

    xi = fx·u·cos ψ,  yi = fy·u·sin ψ          θ the angle to the optical axis, ψ the azimuth

The equidistant one, written in even functions (below), is smooth on the optical axis too. The
others are written in r, s, q without θ: with R = |r, s, q|, sin θ = √(r² + s²)/R and cos θ = −q/R,

    2·tan(θ/2) = 2·sin θ/(1 + cos θ),        2·sin(θ/2) = sin θ·√(2/(1 + cos θ))

and the rays of u: cos θ = (4 − u²)/(4 + u²), 1 − u²/2, √(1 − u²).

Source: Ray (2002), Applied Photographic Optics, chapter on fisheye lenses; Schneider, Schwalbe and
Maas (2009), Validation of geometric models for fisheye lenses, ISPRS Journal 64(3).
"""

from collections.abc import Callable, Sequence

import jax.numpy as jnp

from jaxbundle.cameras.scalars import OfRay, Pair, Parameters, Scalar, ToRay, Triple


def equidistant(columns: Sequence[int], up: bool) -> tuple[OfRay, ToRay]:
    """The ideal image of a ray, and the ray of an ideal image, NaN beyond θ = 180°.

    **Arguments:** as of `perspective.perspective`.
    """
    column_x, column_y = columns[0], columns[-1]

    def ideal(p: Parameters, r: Scalar, s: Scalar, q: Scalar) -> Pair:
        scale = angle_over_sine(r * r + s * s, q)
        return p[column_x] * scale * r, p[column_y] * scale * s if up else -p[column_y] * scale * s

    def ray(p: Parameters, xi: Scalar, yi: Scalar) -> Triple:
        X, Y = xi / p[column_x], yi / p[column_y]
        square = X * X + Y * Y
        square = jnp.where(square < jnp.pi**2, square, jnp.nan)
        scale = sine_over_angle(square)
        return scale * X, scale * Y if up else -scale * Y, -cosine(square)

    return ideal, ray


def stereographic(columns: Sequence[int], y_up: bool) -> tuple[OfRay, ToRay]:
    """As `equidistant`; every ideal image has a ray."""

    def scale(R: Scalar, q: Scalar) -> Scalar:
        return 2 / (R - q)

    def ray(square: Scalar) -> Pair:
        return 4 / (4 + square), (4 - square) / (4 + square)

    return _image(columns, y_up, scale, ray)


def equisolid(columns: Sequence[int], y_up: bool) -> tuple[OfRay, ToRay]:
    """As `equidistant`; NaN beyond θ = 180°."""

    def scale(R: Scalar, q: Scalar) -> Scalar:
        return jnp.sqrt(2 / (R * (R - q)))

    def ray(square: Scalar) -> Pair:
        square = jnp.where(square < 4, square, jnp.nan)
        return jnp.sqrt(1 - square / 4), 1 - square / 2

    return _image(columns, y_up, scale, ray)


def orthographic(columns: Sequence[int], y_up: bool) -> tuple[OfRay, ToRay]:
    """As `equidistant`; NaN from θ = 90° on, where the image would turn back."""

    def scale(R: Scalar, q: Scalar) -> Scalar:
        return jnp.where(q < 0, 1 / R, jnp.nan)

    def ray(square: Scalar) -> Pair:
        cosine = jnp.sqrt(jnp.where(square < 1, 1 - square, jnp.nan))
        return jnp.where(square < 1, 1.0, jnp.nan), cosine

    return _image(columns, y_up, scale, ray)


def _image(
    columns: Sequence[int],
    y_up: bool,
    scale: Callable[[Scalar, Scalar], Scalar],
    ray_of: Callable[[Scalar], tuple[Scalar, Scalar]],
) -> tuple[OfRay, ToRay]:
    """`scale` u/√(r² + s²) of R and q; `ray_of` sin θ/u and cos θ of u²."""
    column_x, column_y = columns[0], columns[-1]

    def ideal(p: Parameters, r: Scalar, s: Scalar, q: Scalar) -> Pair:
        k = scale(jnp.sqrt(r * r + s * s + q * q), q)
        return p[column_x] * k * r, p[column_y] * k * s if y_up else -p[column_y] * k * s

    def ray(p: Parameters, xi: Scalar, yi: Scalar) -> Triple:
        X, Y = xi / p[column_x], yi / p[column_y]
        sine, cosine = ray_of(X * X + Y * Y)
        return X * sine, Y * sine if y_up else -Y * sine, -cosine

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
    is_small = (square < _NEAR * q * q) & (q < 0)
    t2 = jnp.where(is_small, square / jnp.where(is_small, q * q, 1.0), 0.0)
    series = (1 - t2 * (1 / 3 - t2 * (1 / 5 - t2 * (1 / 7 - t2 / 9)))) / jnp.where(
        is_small, -q, 1.0
    )
    rho = jnp.sqrt(jnp.where(is_small, 1.0, square))
    return jnp.where(is_small, series, jnp.arctan2(rho, -q) / rho)


def sine_over_angle(square: Scalar) -> Scalar:
    """sin θ/θ with θ² = `square`."""
    is_small = square < _NEAR
    t2 = jnp.where(is_small, square, 0.0)
    theta = jnp.sqrt(jnp.where(is_small, 1.0, square))
    return jnp.where(is_small, 1 - t2 / 6 * (1 - t2 / 20 * (1 - t2 / 42)), jnp.sin(theta) / theta)


def cosine(square: Scalar) -> Scalar:
    """cos θ with θ² = `square`."""
    is_small = square < _NEAR
    t2 = jnp.where(is_small, square, 0.0)
    theta = jnp.sqrt(jnp.where(is_small, 1.0, square))
    series = 1 - t2 / 2 * (1 - t2 / 12 * (1 - t2 / 30 * (1 - t2 / 56)))
    return jnp.where(is_small, series, jnp.cos(theta))
