"""`kannala-brandt`: the fisheye camera of Kannala and Brandt (2006), as in OpenCV's fisheye module.

    θ = angle between the ray and the optical axis,  ψ = its azimuth in the image
    θd = θ·(1 + k1·θ² + k2·θ⁴ + k3·θ⁶ + k4·θ⁸)
    u = fx·θd·cos ψ + cx,  v = fy·θd·sin ψ + cy

The ideal image is the equidistant one, (fx·θ·cos ψ, fy·θ·sin ψ) from the principal point, and the
distortion a polynomial in it, smooth everywhere. The rest is smooth on the optical axis too, once
it is written in even functions (below), and holds beyond θ = 90°, where q > 0. Only straight
backwards, at θ = 180°, has a ray no azimuth and so no image.

Units: fx, fy, cx, cy in pixels, (0, 0) the centre of the upper-left pixel, u right, v down; the
coefficients without unit, θ in radians.

Source: Kannala and Brandt (2006), IEEE PAMI 28(8), eq. 6; OpenCV 4 documentation, fisheye.
"""

import jax.numpy as jnp

from . import opencv
from .inverse import implicit_inverse
from .model import CameraModel, Pair, Parameters, Scalar, Triple


def ideal(p: Parameters, r: Scalar, s: Scalar, q: Scalar) -> Pair:
    """Equidistant pixel coordinates of a ray, from the principal point, v down."""
    fx, fy = p[0], p[1]
    scale = _angle_over_sine(r * r + s * s, q)
    return fx * scale * r, -fy * scale * s


def ray(p: Parameters, xi: Scalar, yi: Scalar) -> Triple:
    """The ray of equidistant pixel coordinates; NaN beyond θ = 180°, where there is none."""
    fx, fy = p[0], p[1]
    X, Y = xi / fx, yi / fy
    square = X * X + Y * Y
    square = jnp.where(square < jnp.pi**2, square, jnp.nan)
    scale = _sine_over_angle(square)
    return scale * X, -scale * Y, -_cosine(square)


def distort(p: Parameters, xi: Scalar, yi: Scalar) -> Pair:
    """Ideal to measured pixel coordinates: the own formula of `kannala-brandt`."""
    fx, fy, cx, cy, k1, k2, k3, k4 = p
    X, Y = xi / fx, yi / fy
    t2 = X * X + Y * Y
    factor = 1 + t2 * (k1 + t2 * (k2 + t2 * (k3 + t2 * k4)))
    return xi * factor + cx, yi * factor + cy


# The three functions below are even in the angle, so they are smooth in its square, but √ is not at
# 0: near 0 their series stands in, exact to rounding. The inner `where` keeps the derivative of the
# branch not taken finite.

_NEAR = 1e-3


def _angle_over_sine(square, q):
    """θ/ρ with ρ² = `square` = r² + s² and θ = atan2(ρ, −q)."""
    near = (square < _NEAR * q * q) & (q < 0)
    t2 = jnp.where(near, square / jnp.where(near, q * q, 1.0), 0.0)
    series = (1 - t2 * (1 / 3 - t2 * (1 / 5 - t2 * (1 / 7 - t2 / 9)))) / jnp.where(near, -q, 1.0)
    rho = jnp.sqrt(jnp.where(near, 1.0, square))
    return jnp.where(near, series, jnp.arctan2(rho, -q) / rho)


def _sine_over_angle(square):
    """sin θ/θ with θ² = `square`."""
    near = square < _NEAR
    t2 = jnp.where(near, square, 0.0)
    theta = jnp.sqrt(jnp.where(near, 1.0, square))
    return jnp.where(near, 1 - t2 / 6 * (1 - t2 / 20 * (1 - t2 / 42)), jnp.sin(theta) / theta)


def _cosine(square):
    """cos θ with θ² = `square`."""
    near = square < _NEAR
    t2 = jnp.where(near, square, 0.0)
    theta = jnp.sqrt(jnp.where(near, 1.0, square))
    series = 1 - t2 / 2 * (1 - t2 / 12 * (1 - t2 / 30 * (1 - t2 / 56)))
    return jnp.where(near, series, jnp.cos(theta))


KANNALA_BRANDT = CameraModel(
    name="kannala-brandt",
    parameters=("fx", "fy", "cx", "cy", "k1", "k2", "k3", "k4"),
    unit="px",
    axes="down",
    own_formula="from_ideal",
    ideal=ideal,
    ray=ray,
    to_ideal=implicit_inverse(distort, start=opencv.reduce, iterations=12),
    from_ideal=distort,
    principal_distance=("fx", "fy"),
)
