"""Small corrections between detector and ground, each a switch, off by default.

| switch | what | size from 500 to 800 km |
|---|---|---|
| `light_time` | the Earth turns while light travels, by Ω·ρ/c | 0.8 to 1.2 m (equator) |
| `aberration` | the moving camera sees light c·l coming along c·l + v | 13 to 20 m (v/c·ρ) |
| `refraction` | the air bends the ray, n₁·sin i₁ = n₂·sin i₂ | 0.2 m |

These sizes are for 5° off the nadir; at 50° they are 1.3 to 2.1 m, 21 to 34 m, 11 to 15 m.

Which of them are needed depends on the product and cannot be guessed: the quaternions of some
providers contain aberration, those of others do not. All three assume Earth-fixed positions.

The velocity of the aberration is the inertial one, V + Ω × P (classical addition; relativity
changes the direction by (v/c)²/4 at most, 0.2 mm from 800 km). The air is the U.S. Standard
Atmosphere 1976 (`refractivity`).
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from jaxbundle.geometry.ellipsoid import (
    Ellipsoid,
    at_height,
    geodetic,
    normal,
    ray_to_ellipsoid,
)
from jaxbundle.geometry.vectors import (
    Scalar,
    Triple,
    Vector,
    difference,
    dot,
    length,
    point_on_ray,
    scale_vector,
    unit,
    unpack,
)
from jaxbundle.pushbroom.earth_frames import EARTH_RATE
from jaxbundle.pushbroom.refractivity import refractivity

# Speed of light, m/s, exact by the definition of the metre.
LIGHT = 299792458.0

# Heights, in standard deviations from the mean, and weights of the Gauss–Laguerre rule of two
# points: those of an exponential distribution, exact to its third moment. From the upper one down.
NODES = (np.sqrt(2) + 1, (2 - np.sqrt(2)) / 4), (1 - np.sqrt(2), (2 + np.sqrt(2)) / 4)


class Corrections(NamedTuple):
    """Which corrections are applied."""

    light_time: bool = False
    aberration: bool = False
    refraction: bool = False

    @property
    def any(self) -> bool:
        """Whether any is applied."""
        return self.light_time or self.aberration or self.refraction


def true_direction(apparent: Vector, velocity: Vector) -> Triple:
    """The unit vector l of light seen along `apparent`, a: c·l = k·a − v, k > 0."""
    a, b = dot(apparent, apparent), dot(apparent, velocity)
    c = dot(velocity, velocity) - LIGHT**2
    k = (b + jnp.sqrt(b * b - a * c)) / a
    return scale_vector(1 / LIGHT, point_on_ray(scale_vector(-1.0, velocity), apparent, k))


def apparent_direction(true: Vector, velocity: Vector) -> Triple:
    """The direction in which a camera with this velocity sees light from `true`."""
    return point_on_ray(velocity, unit(true), LIGHT)


def inertial_velocity(P: Vector, V: Vector) -> Triple:
    """V + Ω × P."""
    return V[0] - EARTH_RATE * P[1], V[1] + EARTH_RATE * P[0], V[2]


def earlier_earth(v: Vector, distance: Scalar) -> Triple:
    """v in the Earth-fixed frame at the time when light left the ground, `distance` metres ago.

    A negative distance inverts it.
    """
    sine = EARTH_RATE * distance / LIGHT
    cosine = 1 - sine * sine / 2  # the next terms are below rounding: sine is 2e-7 in 800 km
    return cosine * v[0] - sine * v[1], sine * v[0] + cosine * v[1], v[2]


def refract(earth: Ellipsoid | None, height: Scalar, o: Vector, d: Vector) -> tuple[Triple, Triple]:
    """The last straight part of a ray down to a `height`: its origin and direction.

    The air bends the ray over all heights, by dN/dh of N = n − 1. With N₁ at the origin and N₂ at
    the `height`, the mean height of the bending is, above the latter,

        m = ∫ (N − N₁) dh/(N₂ − N₁)                 (integral from the height to the origin).

    The air thins out nearly exponentially; the ray is bent twice, by n₁·sin i₁ = n₂·sin i₂, at the
    two heights and with the two weights that stand for that distribution (`NODES`). The
    displacement is that of the integrated ray within 1e-3 up to 50° off the nadir, 4e-3 at 60°
    (`tests/pushbroom/test_refraction.py`); n·r·sin i is kept on a sphere.

    **Raises:** `ValueError` without an ellipsoid."""
    earth = require_ellipsoid(earth)
    start = geodetic(earth, o)[2]
    heights = jnp.stack(jnp.broadcast_arrays(start, height))
    (N1, N2), (integral1, integral2) = (
        (v[0], v[1]) for v in map(jnp.asarray, refractivity(heights))
    )
    # N₂ − N₁ is the divisor of the mean: 1e-12 moves a ray by 1 µm in 1000 km
    is_bent = (start > height) & (N2 - N1 > 1e-12)
    step = jnp.where(is_bent, N2 - N1, 1.0)
    mean = (integral2 - integral1 - N1 * (start - height)) / step
    # The heights of the bending dN/dh have a standard deviation of 0.86 of their mean above the
    # ground at sea level, 0.88 at 3.4 km, 0.95 at 8.8 km in this atmosphere (1: exponential). Below
    # an aircraft the air ends at the aircraft: the upper border, 1 + √2 < 3 times the spread above
    # the mean, stays under it.
    deviation = jnp.minimum(0.88 * mean, (start - height - mean) / 3)
    *ray, index = *o, *unit(d), N1
    for node, weight in NODES:
        border = at_height(earth, height + mean + node * deviation)
        o, d = unpack(tuple(ray[:3])), unpack(tuple(ray[3:]))
        X = point_on_ray(o, d, ray_to_ellipsoid(border, o, d))
        n = normal(border, X)
        change = weight * step
        ratio = (1 + index) / (1 + index + change)
        # ratio² − 1, without cancellation.
        zeta = -change * (2 + 2 * index + change) / (1 + index + change) ** 2
        k = ratio * dot(d, n)
        bent_direction = point_on_ray(
            scale_vector(ratio, d), n, zeta / (jnp.sqrt(k * k - zeta) - k)
        )
        ray = [jnp.where(is_bent, new, old) for new, old in zip((*X, *bent_direction), ray)]
        index = index + change
    return unpack(tuple(ray[:3])), unpack(tuple(ray[3:]))


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

    The inverse of the corrections of `ground_point`; without corrections X.
    """
    if not corrections.any:
        x, y, z = X
        return x, y, z
    # The corrections of `ground_point` in the opposite order: here the point is known.
    o, distance = P, length(difference(X, P))
    if corrections.light_time:
        # The distance changes by 1e-6 of itself in the first round, by 1e-12 in the second.
        for _ in range(2):
            o = earlier_earth(P, distance)
            distance = length(difference(X, o))
    d = difference(X, o)
    if corrections.refraction:
        height = geodetic(require_ellipsoid(earth), X)[2]
        # A fixed point: the direction whose refracted ray passes X. From 800 km the second round
        # leaves 5 µm at 50° off the nadir, 1 mm at 60°.
        for _ in range(2):
            start, bent = refract(earth, height, o, d)
            nearest = point_on_ray(start, bent, dot(difference(X, start), bent))
            d = point_on_ray(d, difference(X, nearest), 1.0)
    if corrections.light_time:
        d = earlier_earth(d, -distance)
    if corrections.aberration:
        apparent = apparent_direction(d, inertial_velocity(P, V))
        d = scale_vector(length(d) / length(apparent), apparent)
    return point_on_ray(P, d, 1.0)
