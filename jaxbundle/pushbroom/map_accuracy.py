"""Planimetric σ of a map: of the model of the image, of measured image positions, of the terrain.

A pixel of a map shows what the image has at its position, taken to be at the height of the terrain
model. With X(l, p, h; e) the horizontal place at the height h on the ray of the image position
(l, p), e the errors of the ancillary data, all derivatives by automatic differentiation,

    Σ = J_e·Σ_e·J_eᵀ + σ²·J_lp·J_lpᵀ + σ_h²·(∂X/∂h)(∂X/∂h)ᵀ + σ_g²·I,

σ of the image position, σ_h of the heights (∂X/∂h is the slope of the ray, tan of the incidence),
σ_g of the ground, as vendors state it of RPC: for each horizontal axis. Σ is a smooth function of
(l, p, h): it is computed on a lattice of the image and interpolated linearly. Between the records
of a table white noise averages; the lattice shows it as it happens to lie there.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxbundle.geometry.ellipsoid import Ellipsoid, earth_fixed
from jaxbundle.geometry.vectors import unpack
from jaxbundle.pushbroom.error_propagation import east_north, horizontal, propagate_accuracy
from jaxbundle.pushbroom.image import PushbroomImage
from jaxbundle.pushbroom.image_to_ground import locate_point
from jaxbundle.pushbroom.noise import Noise
from jaxbundle.pushbroom.rpc.image import RpcImage
from jaxbundle.pushbroom.rpc.polynomials import locate
from jaxbundle.pushbroom.surfaces import Ground, Height, Plane
from jaxbundle.system.programs import compile_once
from jaxbundle.types import AnyArray, Scalar


class MapErrors(NamedTuple):
    """Standard deviations: of the ancillary data of a rigorous image, of image positions (pixels),
    of the heights of the terrain (metres), of the ground (metres, for each horizontal axis)."""

    noise: Noise = Noise()
    image: float = 0.0
    height: float = 0.0
    ground: float = 0.0


class CovarianceLattice(NamedTuple):
    """Σ at heights × lines × pixels: var(east), var(north), cov(east, north), metres²."""

    heights: Float[np.ndarray, " h"]
    lines: Float[np.ndarray, " l"]
    pixels: Float[np.ndarray, " p"]
    values: Float[np.ndarray, "3 h l p"]


def covariance_lattice(
    image: PushbroomImage | RpcImage,
    earth: Ellipsoid | None,
    heights: tuple[float, float],
    errors: MapErrors,
    size: tuple[int, int, int] = (3, 33, 17),
) -> CovarianceLattice:
    """Σ on a lattice over an image, for heights from the lowest to the highest.

    **Arguments:** `size`: heights, lines, pixels of the lattice. σ of an attitude varies over a
    swath by a few percent: linear interpolation over a sixteenth of it leaves 1e-4 of σ.
    """
    low, high = heights
    # A metre on flat ground, so that there is something to interpolate.
    levels = np.linspace(low, max(high, low + 1.0), size[0])
    lines = np.linspace(0, image.lines - 1, size[1])
    pixels = np.linspace(0, image.pixels - 1, size[2])
    positions = np.repeat(lines, size[2]), np.tile(pixels, size[1])
    components = []
    for level in levels:
        arguments = image, earth, level, *positions, errors.image, errors.height, errors.ground
        sigma = np.array(_ground_covariances(*arguments))
        if isinstance(image, PushbroomImage) and any(np.any(s) for s in errors.noise):
            surface = Plane(level=level) if earth is None else Height(level=level, earth=earth)
            sigma += propagate_accuracy(image, surface, *positions, errors.noise).covariance
        parts = sigma[:, 0, 0], sigma[:, 1, 1], sigma[:, 0, 1]
        components.append(np.stack(parts).reshape(3, *size[1:]))
    return CovarianceLattice(levels, lines, pixels, np.stack(components, 1))


@partial(compile_once, static=1)
def _ground_covariances(
    image: PushbroomImage | RpcImage,
    earth: Ellipsoid | None,
    level: Scalar,
    lines: Float[AnyArray, " n"],
    pixels: Float[AnyArray, " n"],
    sigma_image: Scalar,
    sigma_height: Scalar,
    sigma_ground: Scalar,
) -> Float[Array, "n 2 2"]:
    """The part of Σ that does not come from the ancillary data."""

    def covariance_at(line: Scalar, pixel: Scalar) -> Float[Array, "2 2"]:
        place = jnp.stack([line, pixel, level])
        X0 = _point(image, earth, place)
        axes = east_north(Ground(earth) if earth is not None else Plane(), unpack(X0))
        offset = lambda place: horizontal(axes, unpack(X0), unpack(_point(image, earth, place)))
        J = jax.jacfwd(offset)(place) * jnp.stack([sigma_image, sigma_image, sigma_height])
        return J @ J.T + sigma_ground**2 * jnp.eye(2)

    return jax.vmap(covariance_at)(lines, pixels)


def _point(
    image: PushbroomImage | RpcImage, earth: Ellipsoid | None, place: Float[Array, "3"]
) -> Float[Array, "3"]:
    """The point of (line, pixel, height)."""
    line, pixel, level = place
    if isinstance(image, RpcImage):
        longitude, latitude, _ = locate(image.rpc, line, pixel, level)
        assert earth is not None
        return jnp.stack(earth_fixed(earth, (longitude, latitude, level)))
    surface = Plane(level=level) if earth is None else Height(level=level, earth=earth)
    return jnp.stack([*locate_point(image, surface, line, pixel)])


def interpolate_covariances(
    lattice: CovarianceLattice,
    line: Float[AnyArray, "*shape"],
    pixel: Float[AnyArray, "*shape"],
    height: Float[AnyArray, "*shape"],
) -> Float[np.ndarray, "3 *shape"]:
    """Σ at image positions and heights, NaN where these are."""
    return np.asarray(_interpolate(lattice, line, pixel, height))


@partial(compile_once, static=())
def _interpolate(
    lattice: CovarianceLattice,
    line: Float[AnyArray, "*shape"],
    pixel: Float[AnyArray, "*shape"],
    height: Float[AnyArray, "*shape"],
) -> Float[Array, "3 *shape"]:
    axes = lattice.heights, lattice.lines, lattice.pixels
    # Of an image of one line all lines of the lattice are the same.
    step = lambda axis: jnp.where(axis[1] > axis[0], axis[1] - axis[0], 1.0)
    places = [(value - axis[0]) / step(axis) for value, axis in zip((height, line, pixel), axes)]
    # Of order 1: multilinear; half a pixel beyond the outer centres they are extended.
    interpolate_part = lambda part: jax.scipy.ndimage.map_coordinates(
        part, places, order=1, mode="nearest"
    )
    return jnp.stack([interpolate_part(part) for part in lattice.values])
