"""The ray to a point behind refracting interfaces: plane ones, and the spheres of a dome.

Flat interfaces, parallel to one another (a water surface; air, glass, water of a housing's window).
All of the ray is in the plane of the normal and the point, the plane of refraction. With the
thickness t_k of the layers along the normal, the distance ρ of the point from the normal, and
Snell's n_k·sin θ_k the same in all layers,

    ρ = Σ t_k·tan θ_k,        tan θ_k = w·m/√(n_k² + (n_k² − m²)·w²),    m = min n_k,

where w is tan θ in the layer of the smallest index (Agrawal et al. 2012 remove the roots, and have
an equation of the fourth degree for one interface and of the twelfth for two). Every term is
concave in w, so ρ(w) − ρ is increasing and concave: Newton's method converges from any w below the
root, and never passes it. One unknown, and no total reflection to be avoided on the way. Divided by
ρ, the unknown μ = w/ρ is a smooth function of ρ², also on the normal itself.

A dome: two concentric spheres of radius R and R + t around a centre O in the frame of the camera,
who looks from inside. The ray is in the plane of O, the camera and the point. With e the direction
of the point, r its distance and g = O − e·(e·O) the decentring across it, the ray leaves the camera
along e + α·g; α is the root of the distance of the point from the ray that Snell's law sends
on. It is a smooth function of |g|², also for a centred dome (g = 0), which does not refract.

Everything is differentiable to any order (`jaxbundle.implicit`).

Source: Agrawal, Ramalingam, Taguchi and Chari (2012), A theory of multi-layer flat refractive
geometry; Nocerino et al. (2016) and She, Nakath, Song and Köser (2022) on dome ports.
"""

from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp

from jaxbundle.implicit import implicit_root
from jaxbundle.types import Scalar

Triple = tuple[Scalar, ...]
Pair = tuple[Scalar, Scalar]
# Newton steps from the starts below to rounding (`test_refraction.py`). Flat: 8 for a camera a
# hundredth of the depth before the interface, 10 for a ten-thousandth, 12 however near; dome: 5 for
# a decentring of nine tenths of the radius.
FLAT_ITERATIONS = 12
DOME_ITERATIONS = 6


def refract_flat(
    point: Triple,
    normal: Triple,
    distance: Scalar,
    thickness: Scalar,
    indices: tuple[Scalar, Scalar, Scalar],
) -> Triple:
    """The direction, of any length, in which the camera at the origin sees a point through one or
    two parallel planes.

    **Arguments:** `point`; `normal`, of length 1, from the camera to the point; `distance` of the
    first plane from the camera, and `thickness` of the layer behind it (0: one interface);
    `indices` of refraction at the camera, in the layer, and at the point.

    **Returns:** `point` itself if no interface is between the two: the point is not behind the last
    plane, or the camera not before the first.
    """
    depth = sum(n * x for n, x in zip(normal, point))
    depth_behind = depth - distance - thickness
    lateral = tuple(x - depth * n for n, x in zip(normal, point))
    square = sum(x * x for x in lateral)
    is_between = (distance > 0) & (depth_behind > 0)
    # Layers that there are not would be roots of negative numbers, whose NaN spoils derivatives.
    safe = lambda x: jnp.where(is_between, x, 1.0)
    layers = (safe(distance), jnp.where(is_between, thickness, 0.0), safe(depth_behind))
    smallest_index = jax.lax.stop_gradient(
        jnp.minimum(indices[0], jnp.minimum(indices[1], indices[2]))
    )
    slope = _flat_root(square, layers, indices, smallest_index)
    outward = slope * _tangent(indices[0], smallest_index, slope * slope * square)
    # The ray along the normal plus what it goes across for a unit of it.
    return tuple(
        jnp.where(is_between, n + outward * a, x) for n, a, x in zip(normal, lateral, point)
    )


def _tangent(index: Scalar, smallest_index: Scalar, square: Scalar) -> Scalar:
    """tan θ_k/w for w²."""
    return smallest_index / jnp.sqrt(
        index * index + (index * index - smallest_index * smallest_index) * square
    )


def _flat_remainder(slope: Scalar, fixed: Scalar, data: tuple) -> Scalar:
    """Σ t_k·tan θ_k/ρ − 1 for μ = w/ρ."""
    square, layers, indices = data
    tangents = (t * _tangent(n, fixed, slope * slope * square) for t, n in zip(layers, indices))
    return slope * sum(tangents) - 1


def _flat_root(square: Scalar, layers: Triple, indices: Triple, smallest_index: Scalar) -> Scalar:
    # Two lines above the concave ρ(w): its tangents at 0 and at infinity. Their zeros are below
    # the root, and the larger one is close to it at both ends.
    slope_at_0 = sum(t * smallest_index / n for t, n in zip(layers, indices))
    rise, level = 0.0, 0.0
    for t, n in zip(layers, indices):
        excess = n * n - smallest_index * smallest_index
        denser = excess > 0
        rise = rise + jnp.where(denser, 0.0, t)
        level = level + jnp.where(
            denser, t * smallest_index / jnp.sqrt(jnp.where(denser, excess, 1.0)), 0.0
        )
    # ρ = level + w·rise at infinity; nothing is differentiated here.
    asymptote = (1 - level / jnp.sqrt(square)) / rise
    start = jnp.maximum(1 / slope_at_0, jnp.where(jnp.isfinite(asymptote), asymptote, 0.0))
    return _root(_flat_remainder, start, FLAT_ITERATIONS, smallest_index, (square, layers, indices))


def refract_dome(
    point: Triple,
    centre: Triple,
    radius: Scalar,
    thickness: Scalar,
    indices: tuple[Scalar, Scalar, Scalar],
) -> Triple:
    """The direction, of any length, in which the camera at the origin sees a point through a dome.

    **Arguments:** `point`, and the `centre` of the spheres; inner `radius` and `thickness` of the
    shell; `indices` of refraction inside, in the shell, and outside.

    **Returns:** `point` itself if it is not outside of the dome, or the camera not inside.
    """
    length = jnp.sqrt(sum(x * x for x in point))
    e = tuple(x / length for x in point)
    depth = sum(a * b for a, b in zip(e, centre))
    g = tuple(c - depth * a for a, c in zip(e, centre))
    square_across = sum(x * x for x in g)
    is_outside = (length - depth) ** 2 + square_across > (radius + thickness) ** 2
    is_refracted = is_outside & (depth * depth + square_across < radius * radius)
    # A root for every lane, also where none is used: its NaN would spoil derivatives.
    safe = lambda x, other: jnp.where(is_refracted, x, other)
    data = (
        safe(length, 2 * (1 + thickness)),
        safe(depth, 0.0),
        safe(square_across, 0.0),
        safe(radius, 1.0),
        thickness,
        indices,
    )
    turn = _root(_dome_remainder, jnp.zeros_like(length), DOME_ITERATIONS, None, data)
    return tuple(jnp.where(is_refracted, a + turn * b, x) for a, b, x in zip(e, g, point))


def _dome_remainder(turn: Scalar, _: None, data: tuple) -> Scalar:
    """The distance of the point from the ray that leaves along e + α·g, by |g| and the distance of
    the point; vectors by their coordinates along e and g."""
    length, depth, square_across, radius, thickness, indices = data
    dot = lambda a, b: a[0] * b[0] + square_across * a[1] * b[1]
    move = lambda a, s, b: (a[0] + s * b[0], a[1] + s * b[1])
    size = 1 / jnp.sqrt(1 + square_across * turn * turn)
    ray, point_on_ray = (size, turn * size), (jnp.zeros_like(size), jnp.zeros_like(size))
    for R, n, n_next in (
        (radius, indices[0], indices[1]),
        (radius + thickness, indices[1], indices[2]),
    ):
        to_centre = (depth - point_on_ray[0], 1.0 - point_on_ray[1])
        distance_along = dot(ray, to_centre)
        point_on_ray = move(
            point_on_ray,
            distance_along
            + jnp.sqrt(distance_along * distance_along - dot(to_centre, to_centre) + R * R),
            ray,
        )
        normal = ((point_on_ray[0] - depth) / R, (point_on_ray[1] - 1.0) / R)
        ratio, cosine = n / n_next, dot(ray, normal)
        refracted = jnp.sqrt(1 - ratio * ratio * (1 - cosine * cosine)) - ratio * cosine
        ray = move((ratio * ray[0], ratio * ray[1]), refracted, normal)
    # e and g are at a right angle: the vector product of the coordinates, by |g|.
    return (ray[1] * (length - point_on_ray[0]) + ray[0] * point_on_ray[1]) / length


def _root(
    remainder: Callable, start: Scalar, iterations: int, fixed: Scalar | None, data: Sequence
) -> Scalar:
    """The root of an equation of one unknown as a function of its data."""
    constant_data = jax.lax.stop_gradient(data)
    at_data = lambda x: remainder(x, fixed, constant_data)

    def newton(_: int, x: Scalar) -> Scalar:
        value, slope = jax.jvp(at_data, (x,), (jnp.ones_like(x),))
        return x - value / slope

    start = jnp.asarray(jax.lax.stop_gradient(start), jnp.result_type(float, start))
    root = jax.lax.fori_loop(0, iterations, newton, start)
    solve = lambda times, _, b: b / times(jnp.ones_like(b))
    return implicit_root(remainder, solve, jax.lax.stop_gradient(root), fixed, data)
