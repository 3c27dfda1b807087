"""Small corrections between detector and ground, each a switch, off by default.

| switch | what | size from 500 to 800 km |
|---|---|---|
| `light_time` | the Earth turns while light travels, by Ω·ρ/c | 0.8 to 1.2 m (equator) |
| `aberration` | the moving camera sees light c·l coming along c·l + v | 13 to 20 m (v/c·ρ) |
| `refraction` | layers of air bend the ray, n₁·sin i₁ = n₂·sin i₂ | 0.3 m |

5° off the nadir; at 50° 1.3 to 2.1 m, 21 to 34 m, 12 to 18 m.

They depend on the product and cannot be guessed: the quaternions of some providers contain
aberration, those of others do not. All three assume Earth-fixed positions.

The velocity of the aberration is the inertial one, V + Ω × P (classical addition; relativity
changes 20 m by a micrometre). The layers of air are those of Orekit Rugged (MultiLayerModel): the
refractive index below each height.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxbundle.geometry.ellipsoid import (
    Ellipsoid,
    at_height,
    geodetic,
    normal,
    ray_to_ellipsoid,
    residual,
)
from jaxbundle.geometry.vectors import (
    Scalar,
    Triple,
    Vector,
    along,
    difference,
    dot,
    length,
    scale_vector,
    unit,
    unpack,
)
from jaxbundle.pushbroom.earth_frames import EARTH_RATE

LIGHT = 299792458.0
"""Speed of light, m/s."""

BORDERS = np.array([
    50e3, 40e3, 30e3, 23e3, 18e3, 14e3, 11e3, 9e3, 7e3, 5e3, 3e3, 1e3, 0.0,
])  # fmt: skip
"""Heights of the boundaries between air layers, metres."""
INDICES = 1 + 1e-6 * np.array([
    0, 1, 4, 12, 28, 52, 83, 106, 134, 167, 206, 252, 278, 306,
])  # fmt: skip
"""Refractive index above the first boundary, and below each."""
RATIOS = INDICES[:-1] / INDICES[1:]
ZETAS = np.diff(INDICES) * -(INDICES[:-1] + INDICES[1:]) / INDICES[1:] ** 2
"""(n₁/n₂)² − 1, without cancellation."""

SMALLEST_HEIGHT = 1e-3
"""A layer boundary this close above the ground, in metres, is ignored."""


class Corrections(NamedTuple):
    """Which corrections are applied."""

    light_time: bool = False
    aberration: bool = False
    refraction: bool = False

    @property
    def any(self) -> bool:
        """Whether any is applied."""
        return self.light_time or self.aberration or self.refraction


def true_direction(seen: Vector, velocity: Vector) -> Triple:
    """The unit vector l of light seen along `seen`: c·l = k·seen − v, k > 0."""
    a, b = dot(seen, seen), dot(seen, velocity)
    c = dot(velocity, velocity) - LIGHT**2
    k = (b + jnp.sqrt(b * b - a * c)) / a
    return scale_vector(1 / LIGHT, along(scale_vector(-1.0, velocity), seen, k))


def apparent_direction(true: Vector, velocity: Vector) -> Triple:
    """The direction in which a camera with this velocity sees light from `true`."""
    return along(velocity, unit(true), LIGHT)


def inertial_velocity(P: Vector, V: Vector) -> Triple:
    """V + Ω × P."""
    return V[0] - EARTH_RATE * P[1], V[1] + EARTH_RATE * P[0], V[2]


def earlier_earth(v: Vector, distance: Scalar) -> Triple:
    """v in the Earth-fixed frame at the time when light left the ground, `distance` metres ago.

    A negative distance inverts it.
    """
    sine = EARTH_RATE * distance / LIGHT
    cosine = 1 - sine * sine / 2  # the next terms are below rounding
    return cosine * v[0] - sine * v[1], sine * v[0] + cosine * v[1], v[2]


def refract(
    earth: Ellipsoid | None, height: Scalar, o: Vector, d: Vector
) -> tuple[Triple, Triple]:
    """The last straight part of a ray down to a `height`: its origin and direction.

    **Raises:** `ValueError` without an ellipsoid."""
    earth = require_ellipsoid(earth)

    def through(ray, layer):
        (o, d), (border, ratio, zeta) = ray, layer
        surface = at_height(earth, border)
        X = along(o, d, ray_to_ellipsoid(surface, o, d))
        n = normal(surface, X)
        k = ratio * dot(d, n)
        bent = along(scale_vector(ratio, d), n, zeta / (jnp.sqrt(k * k - zeta) - k))
        passed = (border > height + SMALLEST_HEIGHT) & (residual(surface, o) > 0)
        choose = lambda new, old: tuple(jnp.where(passed, a, b) for a, b in zip(new, old))
        return (choose(X, o), choose(bent, d)), None

    # a loop: unrolled layers would take minutes to compile
    *ray, _ = jnp.broadcast_arrays(*o, *unit(d), height)
    ends = tuple(ray[:3]), tuple(ray[3:])
    (start, bent), _ = jax.lax.scan(through, ends, (BORDERS, RATIOS, ZETAS))
    return unpack(start), unpack(bent)


def require_ellipsoid(earth: Ellipsoid | None) -> Ellipsoid:
    """The ellipsoid that heights refer to.

    **Raises:** `ValueError` in a local frame, which has none."""
    if earth is None:
        raise ValueError("refraction and RPC need heights above an ellipsoid; give one as `earth`")
    return earth


def apparent_point(
    corrections: Corrections, earth: Ellipsoid | None, P: Vector, V: Vector, X: Vector
) -> Triple:
    """The apparent position of the point X for a camera at P with the velocity V.

    The inverse of the ray corrections of `locate`; without corrections X.
    """
    if not corrections.any:
        x, y, z = X
        return x, y, z
    o, distance = P, length(difference(X, P))
    if corrections.light_time:
        for _ in range(2):
            o = earlier_earth(P, distance)
            distance = length(difference(X, o))
    d = difference(X, o)
    if corrections.refraction:
        height = geodetic(require_ellipsoid(earth), X)[2]
        for _ in range(2):
            start, bent = refract(earth, height, o, d)
            nearest = along(start, bent, dot(difference(X, start), bent))
            d = along(d, difference(X, nearest), 1.0)
    if corrections.light_time:
        d = earlier_earth(d, -distance)
    if corrections.aberration:
        seen = apparent_direction(d, inertial_velocity(P, V))
        d = scale_vector(length(d) / length(seen), seen)
    return along(P, d, 1.0)
