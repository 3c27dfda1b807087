"""Three ideal images of fisheyes beside the equidistant one (`equidistant.py`).

    stereographic   u = 2·tan(θ/2)     conformal; rays to 180°, which have no image
    equisolid       u = 2·sin(θ/2)     equal areas; rays to 180°, on the circle u = 2
    orthographic    u = sin θ          rays to 90°, on the circle u = 1

    xi = fx·u·cos ψ,  yi = fy·u·sin ψ          θ the angle to the optical axis, ψ the azimuth

Written in r, s, q without θ: with R = |r, s, q|, sin θ = √(r² + s²)/R and cos θ = −q/R,

    2·tan(θ/2) = 2·sin θ/(1 + cos θ),        2·sin(θ/2) = sin θ·√(2/(1 + cos θ))

and the rays of u: cos θ = (4 − u²)/(4 + u²), 1 − u²/2, √(1 − u²).

Source: Ray (2002), Applied Photographic Optics, chapter on fisheye lenses; Schneider, Schwalbe and
Maas (2009), Validation of geometric models for fisheye lenses, ISPRS Journal 64(3).
"""

from collections.abc import Callable, Sequence

import jax.numpy as jnp

from jaxbundle.cameras.scalars import OfRay, Pair, Parameters, Scalar, ToRay, Triple


def stereographic(columns: Sequence[int], up: bool) -> tuple[OfRay, ToRay]:
    """The ideal image of a ray, and the ray of an ideal image; arguments as of `perspective`."""

    def scale(R: Scalar, q: Scalar) -> Scalar:
        return 2 / (R - q)

    def ray(square: Scalar) -> Pair:
        return 4 / (4 + square), (4 - square) / (4 + square)

    return _image(columns, up, scale, ray)


def equisolid(columns: Sequence[int], up: bool) -> tuple[OfRay, ToRay]:
    """As `stereographic`; NaN beyond θ = 180°."""

    def scale(R: Scalar, q: Scalar) -> Scalar:
        return jnp.sqrt(2 / (R * (R - q)))

    def ray(square: Scalar) -> Pair:
        square = jnp.where(square < 4, square, jnp.nan)
        return jnp.sqrt(1 - square / 4), 1 - square / 2

    return _image(columns, up, scale, ray)


def orthographic(columns: Sequence[int], up: bool) -> tuple[OfRay, ToRay]:
    """As `stereographic`; NaN from θ = 90° on, where the image would turn back."""

    def scale(R: Scalar, q: Scalar) -> Scalar:
        return jnp.where(q < 0, 1 / R, jnp.nan)

    def ray(square: Scalar) -> Pair:
        cosine = jnp.sqrt(jnp.where(square < 1, 1 - square, jnp.nan))
        return jnp.where(square < 1, 1.0, jnp.nan), cosine

    return _image(columns, up, scale, ray)


def _image(
    columns: Sequence[int],
    up: bool,
    scale: Callable[[Scalar, Scalar], Scalar],
    ray_of: Callable[[Scalar], tuple[Scalar, Scalar]],
) -> tuple[OfRay, ToRay]:
    """`scale` u/√(r² + s²) of R and q; `ray_of` sin θ/u and cos θ of u²."""
    first, last = columns[0], columns[-1]

    def ideal(p: Parameters, r: Scalar, s: Scalar, q: Scalar) -> Pair:
        k = scale(jnp.sqrt(r * r + s * s + q * q), q)
        return p[first] * k * r, p[last] * k * s if up else -p[last] * k * s

    def ray(p: Parameters, xi: Scalar, yi: Scalar) -> Triple:
        X, Y = xi / p[first], yi / p[last]
        sine, cosine = ray_of(X * X + Y * Y)
        return X * sine, Y * sine if up else -Y * sine, -cosine

    return ideal, ray
