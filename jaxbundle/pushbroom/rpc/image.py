"""An image by rational polynomials, asked for ground points and map pixels as a rigorous one is.

`PushbroomImage` answers by trajectory and optics (`image_to_ground`, `rectification`), `RpcImage`
by the polynomials, which hold for the Earth of WGS84 only.
"""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxbundle.geometry.ellipsoid import WGS84, earth_fixed, geodetic
from jaxbundle.geometry.vectors import difference, dot, length
from jaxbundle.pushbroom.rpc.polynomials import (
    Rpc,
    fit_inverse,
    locate_on,
    normalise,
    project,
    sight,
)
from jaxbundle.pushbroom.surfaces import GroundSurface
from jaxbundle.types import AnyArray, Scalar

# The part of the domain, in longitude and latitude, whose terrain is read and whose points can be
# in the image. Normalised coordinates are in ±1 by definition; a fifth more for images that reach
# beyond. Farther out a cubic may return to the image: the same ground would be mapped twice.
REACH = 1.2


class RpcImage(eqx.Module):
    """The polynomials and the size of their image; `sized`: whether that is of its raster, or only
    where the polynomials hold."""

    rpc: Rpc
    lines: int = eqx.field(static=True)
    pixels: int = eqx.field(static=True)
    sized: bool = eqx.field(static=True, default=True)


def heights_of(rpc: Rpc) -> tuple[float, float]:
    """The heights between which the polynomials hold, metres, to a millimetre."""
    middle, half_range = float(rpc.height_offset), abs(float(rpc.height_scale))
    # + 0.0: of −0 made by rounding
    return round(middle - half_range, 3) + 0.0, round(middle + half_range, 3) + 0.0


def heights_in_words(rpc: Rpc) -> str:
    """The same, for messages."""
    return " to ".join(f"{h:.10g}" for h in heights_of(rpc))


def locate_rpc_lines(
    image: RpcImage,
    surface: GroundSurface,
    lines: Float[AnyArray, " lines"],
    pixels: Float[AnyArray, " pixels"],
) -> Float[Array, "3 lines pixels"]:
    """The points of all pixels of all lines, Earth-fixed; NaN where a ray misses the surface."""
    locate_point = _point_at(image.rpc, surface)
    # Row by row, like `locate_lines`.
    of_line = lambda line: jax.vmap(lambda pixel: locate_point(line, pixel)[0])(pixels)
    return jnp.moveaxis(jax.lax.map(of_line, lines), -1, 0)


def locate_rpc_points(
    image: RpcImage,
    surface: GroundSurface,
    lines: Float[AnyArray, " n"],
    pixels: Float[AnyArray, " n"],
) -> tuple[Float[Array, "3 n"], Int[Array, " n"]]:
    """The points of scattered image positions, Earth-fixed, and their `RpcStatus`; NaN where a ray
    misses the surface."""
    X, status = jax.vmap(_point_at(image.rpc, surface))(lines, pixels)
    return X.T, status


def _point_at(rpc: Rpc, surface: GroundSurface) -> Callable[[Scalar, Scalar], tuple[Array, Array]]:
    """The point of an image position, and its `RpcStatus`."""
    inverse, earth = fit_inverse(rpc), surface.earth or WGS84

    def locate_point(line: Scalar, pixel: Scalar) -> tuple[Array, Array]:
        longitude, latitude, height, status = locate_on(rpc, surface, line, pixel, inverse)
        return jnp.stack(earth_fixed(earth, (longitude, latitude, height))), status

    return locate_point


def project_to_rpc(
    rpc: Rpc, surface: GroundSurface, ground: Float[AnyArray, "3 *points"]
) -> tuple[Array, Array]:
    """Lines and pixels of Earth-fixed points; NaN beyond the reach of the polynomials."""
    longitude, latitude, height = geodetic(surface.earth or WGS84, tuple(ground))
    L, P, _ = normalise(rpc, longitude, latitude, height)
    line, pixel = project(rpc, longitude, latitude, height)
    is_in_reach = (jnp.abs(L) <= REACH) & (jnp.abs(P) <= REACH)
    return jnp.where(is_in_reach, line, jnp.nan), jnp.where(is_in_reach, pixel, jnp.nan)


def are_occluded_in_rpc(
    rpc: Rpc,
    surface: GroundSurface,
    line: Float[AnyArray, "rows columns"],
    pixel: Float[AnyArray, "rows columns"],
    ground: Float[AnyArray, "3 rows columns"],
    half_pixel: Scalar,
) -> Bool[Array, "rows columns"]:
    """Whether the rays of image positions end before their points, by more than half a pixel of the
    map, metres (see `rectification`)."""
    inverse, locate_point = fit_inverse(rpc), _point_at(rpc, surface)

    def is_occluded(line: Scalar, pixel: Scalar, X: Float[Array, "3"]) -> Array:
        _, downwards = sight(rpc, line, pixel, surface.earth or WGS84, inverse)
        gap = difference(X, locate_point(line, pixel)[0])
        return jnp.asarray((dot(gap, downwards) > 0) & (length(gap) > half_pixel))

    of_row = lambda row: jax.vmap(is_occluded)(*row)
    return jax.lax.map(of_row, (line, pixel, jnp.moveaxis(ground, 0, -1)))
