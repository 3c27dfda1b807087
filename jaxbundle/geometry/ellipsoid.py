"""The ellipsoid: where a ray meets it, geodetic coordinates, normal.

    x²/a² + y²/b² + z²/c² = 1

**Ray.** The ray o + s·d meets the ellipsoid where, with W = diag(a⁻², b⁻², c⁻²),

    A·s² + 2·B·s + C = 0,    A = dᵀWd,  B = oᵀWd,  C = oᵀWo − 1,
    q = −(B + sgn(B)·√(B² − A·C)),    s = q/A  or  s = C/q

without cancellation (Press et al., 2007, Numerical Recipes, 5.6). The nearest root in front counts.

**Geodetic coordinates** of an ellipsoid of revolution (a = b): with e² = 1 − c²/a²,
N = a/√(1 − e²·sin²φ),

    x = (N + h)·cos φ·cos λ,   y = (N + h)·cos φ·sin λ,   z = (N·(1 − e²) + h)·sin φ.

The reverse finds the tangent S/C of the reduced latitude by two of Halley's iterations, without
any transcendental function (Fukushima, 2006, Journal of Geodesy 79, 689–693). From 10 km below to
1000 km above the ellipsoid it is exact to the rounding of the coordinates, 3 nm.
"""

from typing import NamedTuple

import jax.numpy as jnp

from jaxbundle.geometry.vectors import Scalar, Triple, Vector, dot, point_on_ray, unit


class Ellipsoid(NamedTuple):
    """Semi-axes along x, y, z, in metres; three equal ones make a sphere."""

    a: Scalar
    b: Scalar
    c: Scalar


WGS84 = Ellipsoid(6378137.0, 6378137.0, 6356752.314245179)


def sphere(radius: Scalar) -> Ellipsoid:
    """The sphere of this radius, in metres."""
    return Ellipsoid(radius, radius, radius)


def at_height(ellipsoid: Ellipsoid, h: Scalar) -> Ellipsoid:
    """The ellipsoid with semi-axes longer by h: within 6e-6·h of the surface of height h."""
    return Ellipsoid(*(axis + h for axis in ellipsoid))


def ray_to_ellipsoid(ellipsoid: Ellipsoid, o: Vector, d: Vector) -> Scalar:
    """The distance s > 0, in lengths of d, of the nearest point o + s·d.

    NaN for a ray that misses.
    """
    p, u = _on_axes(ellipsoid, o), _on_axes(ellipsoid, d)
    A, B, C = dot(u, u), dot(p, u), dot(p, p) - 1
    discriminant = B * B - A * C
    real = discriminant >= 0
    root = jnp.sqrt(jnp.where(discriminant > 0, discriminant, 1.0)) * (discriminant > 0)
    q = -(B + jnp.where(B < 0, -root, root))
    root_a, root_b = q / A, C / jnp.where(q == 0, 1.0, q)
    smaller, larger = jnp.minimum(root_a, root_b), jnp.maximum(root_a, root_b)
    s = jnp.where(smaller > 0, smaller, larger)
    return jnp.where(real & (s > 0), s, jnp.nan)


def ray_to_height(ellipsoid: Ellipsoid, h: Scalar, o: Vector, d: Vector) -> Scalar:
    """As `ray_to_ellipsoid`, for the surface of geodetic height h, metres, of a spheroid.

    From the ellipsoid with longer axes, two Newton steps along the ray, ∂h/∂s = n·d.
    """
    s = ray_to_ellipsoid(at_height(ellipsoid, h), o, d)
    for _ in range(2):
        X = point_on_ray(o, d, s)
        _, height, n = _foot(ellipsoid, X)
        s = s + (h - height) / dot(n, d)
    return s


def normal(ellipsoid: Ellipsoid, X: Vector) -> Triple:
    """The outward unit normal at a point of the ellipsoid."""
    x, y, z = (component / axis**2 for component, axis in zip(X, ellipsoid))
    return unit((x, y, z))


def residual(ellipsoid: Ellipsoid, X: Vector) -> Scalar:
    """x²/a² + y²/b² + z²/c² − 1: zero on the ellipsoid, 2/a times the height near it."""
    p = _on_axes(ellipsoid, X)
    return dot(p, p) - 1


def geodetic(ellipsoid: Ellipsoid, X: Vector) -> Triple:
    """(λ, φ, h): longitude and latitude in radians, height in metres, of an Earth-fixed point.

    The ellipsoid is one of revolution, a = b. At a pole the longitude is 0.
    """
    x, y, _ = X
    pole = (x == 0) & (y == 0)
    longitude = jnp.arctan2(y, jnp.where(pole, 1.0, x))
    tangent, h, _ = _foot(ellipsoid, X)
    return longitude, jnp.arctan2(*tangent), h


def earth_fixed(ellipsoid: Ellipsoid, geodetic: Vector) -> Triple:
    """(x, y, z) in metres of (λ, φ, h), radians and metres; a = b."""
    longitude, latitude, h = geodetic
    squeeze = (ellipsoid.c / ellipsoid.a) ** 2
    sine, cosine = jnp.sin(latitude), jnp.cos(latitude)
    N = ellipsoid.a / jnp.sqrt(1 - (1 - squeeze) * sine**2)
    radius = (N + h) * cosine
    return radius * jnp.cos(longitude), radius * jnp.sin(longitude), (N * squeeze + h) * sine


def vertical(geodetic: Vector) -> Triple:
    """The unit vector of increasing height at (λ, φ, h)."""
    longitude, latitude, _ = geodetic
    cosine = jnp.cos(latitude)
    return cosine * jnp.cos(longitude), cosine * jnp.sin(longitude), jnp.sin(latitude)


def _on_axes(ellipsoid: Ellipsoid, v: Vector) -> Triple:
    """(x/a, y/b, z/c): the ellipsoid as the unit sphere."""
    x, y, z = (component / axis for component, axis in zip(v, ellipsoid))
    return x, y, z


def _foot(ellipsoid: Ellipsoid, X: Vector) -> tuple[tuple[Scalar, Scalar], Scalar, Triple]:
    """Sine and cosine of the latitude to a common factor, height, and unit normal (Fukushima)."""
    x, y, z = X
    a, c = ellipsoid.a, ellipsoid.c
    square = x * x + y * y
    # On the axis the iteration would divide zero by zero. 1e-13 metres: no coordinate on the Earth
    # has digits so small (rounding: 1e-9), and its square has all digits.
    smallest_radius = 1e-13
    p = jnp.sqrt(jnp.where(square > smallest_radius**2, square, smallest_radius**2))
    k = c / a
    E, P, Z = 1 - k * k, p / a, k * z / a
    S, C = Z, k * P
    # Halley's method, S and C up to a common factor: every step triples the correct digits.
    for _ in range(2):
        A = jnp.sqrt(S * S + C * C)
        D, F = Z * A**3 + E * S**3, P * A**3 - E * C**3
        B = 1.5 * E * S * C * C * ((P * S - Z * C) * A - E * S * C)
        S, C = D * F - B * S, F * F - B * C
    kC = k * C
    size = jnp.sqrt(kC * kC + S * S)
    A = jnp.sqrt(S * S + C * C)
    h = ((p - a * C / A) * kC + (z - c * S / A) * S) / size
    horizontal = kC / (size * p)
    return (S, kC), h, (horizontal * x, horizontal * y, S / size)
