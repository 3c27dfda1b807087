"""Image → ground: the first point of a pixel's ray on a surface.

    [X, Y, Z] = P + s·R·[ξ, η, −1]

One pose per line, pixel directions once for all lines: a whole line costs little more than its
intersections with the surface. `locate_point` is the textbook's formula of one pixel,
`locate_lines` the same for lines × pixels, `locate_points` for scattered places.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxbundle.arguments import without_masks
from jaxbundle.errors import InputError
from jaxbundle.geometry.vectors import Triple, difference, length, point_on_ray, rotate
from jaxbundle.pushbroom.corrections import Corrections, earlier_earth, inertial_velocity, refract
from jaxbundle.pushbroom.corrections import true_direction as without_aberration
from jaxbundle.pushbroom.image import LinePose, PushbroomImage, pose_at
from jaxbundle.pushbroom.scanner import Pair, slopes_of
from jaxbundle.pushbroom.surfaces import GroundSurface
from jaxbundle.types import AnyArray, Scalar


def locate_point(
    image: PushbroomImage, surface: GroundSurface, line: Scalar, pixel: Scalar
) -> Triple:
    """The point (X, Y, Z), in metres, of an image position; NaN if the ray misses."""
    pose = pose_at(image, image.times.time(line))
    return ground_point(pose, image.optics.slopes(pixel), surface, image.corrections)


def ground_point(
    pose: LinePose, slopes: Pair, surface: GroundSurface, corrections: Corrections
) -> Triple:
    """The first point on the surface in the direction [ξ, η, −1] of a pose."""
    P, R, V = pose
    # Backwards along the way of the light: aberration happens in the camera; the Earth has turned
    # since the light left; refraction is last, as it needs the height of the point.
    o, d = P, rotate(R, (*slopes, -1.0))
    if corrections.aberration:
        d = without_aberration(d, inertial_velocity(o, V))
    X = point_on_ray(o, d, surface.distance(o, d))
    if corrections.light_time:
        start, direction = o, d
        # The distance changes by 1e-6 of itself in the first round, by 1e-12 in the second.
        for _ in range(2):
            distance = length(difference(X, o))
            o, d = earlier_earth(start, distance), earlier_earth(direction, distance)
            X = point_on_ray(o, d, surface.distance(o, d))
    if corrections.refraction:
        o, d = refract(surface.earth, surface.height(X), o, d)
        X = point_on_ray(o, d, surface.distance(o, d))
    return X


@without_masks
def locate_lines(
    image: PushbroomImage,
    surface: GroundSurface,
    lines: Float[AnyArray, " lines"],
    pixels: Float[AnyArray, " pixels"],
) -> Float[Array, "3 lines pixels"]:
    """The points of all pixels of all lines, coordinates first."""
    slopes = slopes_of(image.optics, pixels)

    def locate_line(line: Scalar) -> Triple:
        pose = pose_at(image, image.times.time(line))
        point = lambda slopes: ground_point(pose, slopes, surface, image.corrections)
        return jax.vmap(point)(slopes)

    if surface.iterative:
        # The state of a loop over 8000 pixels stays in the cache, that of many lines does not.
        return jnp.stack(jax.lax.map(locate_line, lines), axis=0)
    return jnp.stack(jax.vmap(locate_line)(lines))


@without_masks
def locate_points(
    image: PushbroomImage,
    surface: GroundSurface,
    lines: Float[AnyArray, " n"],
    pixels: Float[AnyArray, " n"],
) -> Float[Array, "3 n"]:
    """The points of scattered image positions, with one pose each; positions outside the image are
    extrapolated. The surface is one of the frame of the image: `Plane` in a local one, `Height` of
    its ellipsoid on a planet.

    **Raises:** `InputError` for lines and pixels that are not arrays [n]."""
    lines, pixels = jnp.asarray(lines, float), jnp.asarray(pixels, float)
    if lines.ndim != 1 or lines.shape != pixels.shape:
        raise InputError(
            f"lines and pixels: expected two arrays [n], got {lines.shape} and {pixels.shape}"
        )
    return jnp.stack(jax.vmap(lambda l, u: locate_point(image, surface, l, u))(lines, pixels))
