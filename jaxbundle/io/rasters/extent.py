"""The extent of the required terrain: longitudes and latitudes visible in an image.

A ray meets the ground between the highest and the lowest possible height of the terrain;
the extent contains both ends of the rays of a lattice over the image.
"""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Float

from jaxbundle.geometry.ellipsoid import Ellipsoid, geodetic
from jaxbundle.pushbroom.image import PushbroomImage, pose_at
from jaxbundle.pushbroom.image_to_ground import locate_lines
from jaxbundle.pushbroom.rpc.image import REACH
from jaxbundle.pushbroom.rpc.polynomials import Rpc
from jaxbundle.pushbroom.surfaces import Height
from jaxbundle.system.programs import compile_once

# Metres, limits for the Earth with its sea floor, the Moon and Mars: the deepest place of all is
# the Mariana Trench (−11 km), the highest Olympus Mons (22 km).
HEIGHTS = -12_000.0, 25_000.0


class Extent(NamedTuple):
    """Degrees; `east` may be beyond 180°."""

    west: float
    south: float
    east: float
    north: float

    def __str__(self) -> str:
        return (
            f"longitude {self.west:.4g}° to {self.east:.4g}°, latitude {self.south:.4g}° to "
            f"{self.north:.4g}°"
        )


def image_extent(image: PushbroomImage, earth: Ellipsoid, places: int = 17) -> Extent | None:
    """The visible extent of an image; None if it shows the horizon or the pole.

    **Arguments:** `places`: lines and pixels of the lattice; what bends between them must stay in
    the margin of the extent, 3 % of its size."""
    lines, pixels = (np.linspace(0, n - 1, places) for n in (image.lines, image.pixels))
    low, high = (
        np.asarray(_locate(image, Height(level=h, earth=earth), lines, pixels)) for h in HEIGHTS
    )
    if not np.isfinite(low).all():
        return None
    # Below the highest height rays begin at the camera.
    P = np.asarray(_positions(image, image.times.time(lines))).T[:, :, None]
    high = np.where(np.isfinite(high), high, P)
    X = np.stack([low, high], axis=1)
    longitude, latitude, _ = (np.degrees(np.asarray(v)) for v in _geodetic(earth, tuple(X)))
    middle = longitude[0, places // 2, places // 2]
    longitude = longitude - 360 * np.round((longitude - middle) / 360)
    return _extent_around(longitude, latitude)


def pole_in_image(image: PushbroomImage, earth: Ellipsoid, places: int = 17) -> str | None:
    """The pole that an image shows, in words; None if it shows none, or if its border misses the
    ground.

    The longitudes along the border of the image then lead once around the Earth.

    **Arguments:** `places`: lines and pixels of the lattice, as of `image_extent`."""
    lines, pixels = (np.linspace(0, n - 1, places) for n in (image.lines, image.pixels))
    X = np.asarray(_locate(image, Height(level=0.0, earth=earth), lines, pixels))
    border = np.concatenate([X[:, 0], X[:, 1:, -1], X[:, -1, -2::-1], X[:, -2::-1, 0]], axis=1)
    if not np.isfinite(border).all():
        return None
    winding_angle = np.diff(np.unwrap(np.arctan2(border[1], border[0]))).sum()
    if abs(winding_angle) < np.pi:
        return None
    return "North Pole" if border[2].mean() > 0 else "South Pole"


def rpc_extent(rpc: Rpc) -> Extent | None:
    """The validity domain of coefficients."""
    ends = np.array([-REACH, REACH])
    return _extent_around(
        float(rpc.longitude_offset) + abs(float(rpc.longitude_scale)) * ends,
        float(rpc.latitude_offset) + abs(float(rpc.latitude_scale)) * ends,
    )


def joint_extent(extents: Sequence[Extent | None]) -> Extent | None:
    """The extent of several images; None if one has none."""
    known_extents = [extent for extent in extents if extent is not None]
    if len(known_extents) < len(extents) or not known_extents:
        return None
    # The turn that brings each nearest to the first.
    longitude_shifts = [
        360 * round((known_extents[0].west - extent.west) / 360) for extent in known_extents
    ]
    return Extent(
        min(
            extent.west + longitude_shift
            for extent, longitude_shift in zip(known_extents, longitude_shifts)
        ),
        min(extent.south for extent in known_extents),
        max(
            extent.east + longitude_shift
            for extent, longitude_shift in zip(known_extents, longitude_shifts)
        ),
        max(extent.north for extent in known_extents),
    )


def _extent_around(
    longitude: Float[np.ndarray, "..."], latitude: Float[np.ndarray, "..."]
) -> Extent | None:
    """The extent of points with a margin; None at a pole, where all longitudes may be visible."""
    # Within 5° (560 km) of a pole an image may contain it.
    if np.abs(latitude).max() > 85 or np.ptp(longitude) > 180:
        return None
    wider = 0.03 * np.ptp(longitude), 0.03 * np.ptp(latitude)  # the bends between the rays
    return Extent(
        float(longitude.min() - wider[0]),
        float(latitude.min() - wider[1]),
        float(longitude.max() + wider[0]),
        float(latitude.max() + wider[1]),
    )


_locate = compile_once(locate_lines, ())
_geodetic = compile_once(geodetic, ())
_positions = compile_once(jax.vmap(lambda image, t: pose_at(image, t).P, (None, 0)), ())
