"""Coordinates of maps: pyproj's systems, and grids of pixels in them.

Longitudes of a map are continuous: they continue beyond ±180° if required, such as 179.9 to
180.4, which GDAL and its users read. A projected system with an edge there is refused.
"""

from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from jaxtyping import Float

from jaxbundle.errors import InputError
from jaxbundle.geometry.ellipsoid import Ellipsoid, geodetic
from jaxbundle.photographs.places import utm_system
from jaxbundle.pushbroom.rectification import MapNodes, geographic_nodes, local_nodes
from jaxbundle.pushbroom.surfaces import GroundSurface
from jaxbundle.system.programs import compile_once

if TYPE_CHECKING:
    from pyproj import Transformer


_geodetic = compile_once(geodetic, ())


class MapSystem:
    """A coordinate system of maps, for points of an Earth or of a local frame.

    `crs` is anything pyproj reads, such as `"EPSG:32633"`; None: longitude and latitude in degrees,
    or X and Y of the local frame. `turn` is the change of x in a turn around the Earth, None if x
    is not a longitude.

    **Raises:** `InputError` for systems unknown to pyproj, and other than map systems.
    """

    def __init__(self, earth: Ellipsoid | None, crs: str | None):
        self.earth, self.crs = earth, crs
        self.transformer = None
        self.turn = None if earth is None else 360.0
        if earth is None and crs is not None:
            raise InputError(f"coordinate system {crs}: a local frame has none; omit it")
        if earth is not None and crs is not None:
            self.transformer, self.turn = _transformer(crs)

    def from_ground(self, X: Float[np.ndarray, "3 *shape"]) -> tuple[np.ndarray, np.ndarray]:
        """x and y of ground points; NaN outside the domain of the system."""
        if self.earth is None:
            return X[0], X[1]
        longitude, latitude, _ = _geodetic(self.earth, tuple(X))
        degrees = np.degrees(np.asarray(longitude)), np.degrees(np.asarray(latitude))
        if not self.transformer:
            return degrees
        x, y = (np.asarray(v) for v in self.transformer.transform(*degrees))
        # Pyproj gives infinity.
        return np.where(np.isfinite(x), x, np.nan), np.where(np.isfinite(y), y, np.nan)

    def unwrap(self, x: np.ndarray, middle: float) -> np.ndarray:
        """The longitudes shifted by full turns to within half a turn of the middle."""
        return x if self.turn is None else x - self.turn * np.round((x - middle) / self.turn)

    def nodes(self, surface: GroundSurface, x: np.ndarray, y: np.ndarray) -> MapNodes:
        """Ground points at x and y."""
        if self.earth is None:
            return local_nodes(x, y)
        if self.transformer:
            x, y = self.transformer.transform(x, y, direction="INVERSE")
        return geographic_nodes(surface, np.radians(x), np.radians(y))

    def degrees_of(self, grid: "MapGrid") -> tuple[float, float] | None:
        """Longitude and latitude of the middle of a map; None without a system."""
        if not self.transformer:
            return None
        x, y = grid.x + grid.columns * grid.size / 2, grid.y - grid.rows * grid.size / 2
        longitude, latitude = self.transformer.transform(x, y, direction="INVERSE")
        return float(longitude), float(latitude)

    @property
    def text(self) -> str | None:
        """The system in the form of rasterio."""
        return self.crs if self.crs or self.earth is None else "EPSG:4326"

    @property
    def unit(self) -> str:
        """The unit of pixel sizes, for messages."""
        if self.earth is None:
            return "metres"
        return "degrees" if self.transformer is None else f"units of {self.crs}"


class MapGrid(NamedTuple):
    """Pixels of a map, north up: the outer corner (x, y) of the first one, their size."""

    x: float
    y: float
    size: float
    columns: int
    rows: int

    def centres(
        self, row: Float[np.ndarray, " r"], column: Float[np.ndarray, " c"]
    ) -> Sequence[Float[np.ndarray, "r c"]]:
        """x and y of the centres of rows × columns."""
        return np.meshgrid(self.x + (column + 0.5) * self.size, self.y - (row + 0.5) * self.size)

    def place(self, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Row and column, whole numbers at the centres, of map coordinates."""
        return (self.y - y) / self.size - 0.5, (x - self.x) / self.size - 0.5


def describe_distance(
    crs: str | None, longitude: float, latitude: float, margin: float = 6.0
) -> str:
    """What to say of a system made for another part of the Earth than a place, degrees; empty if
    there is nothing to say.

    **Arguments:** `margin`: degrees around its area of use within which it is used all the same: a
    zone of UTM, whose neighbours are often mapped in it."""
    if crs is None:
        return ""
    transformer, _ = _transformer(crs)
    target = transformer.target_crs
    area = None if target is None else target.area_of_use
    if target is None or area is None:
        return ""
    # An area across the date line has its east smaller than its west.
    width = (area.east - area.west) % 360 or 360
    beyond = (longitude - area.west + margin) % 360 > width + 2 * margin and width < 360
    if not beyond and area.south - margin <= latitude <= area.north + margin:
        return ""
    return (
        f"--crs {crs} ({target.name}) is made for longitude {area.west:g}° to "
        f"{area.east:g}°, latitude {area.south:g}° to {area.north:g}°; the image is at "
        f"{longitude:.4g}°, {latitude:.4g}°: distances are distorted there; is it meant? Its zone "
        f"of UTM is {utm_system(latitude, longitude)}"
    )


def check_away_from_poles(
    system: MapSystem, y: Float[np.ndarray, "r c"], farthest: float = 89.0
) -> None:
    """Refuse a map in longitude and latitude of a place at a pole, which would be torn apart.

    **Arguments:** `farthest`: degrees, beyond which a degree of longitude is less than a 57th of
    one of latitude, so that square pixels show nothing.

    **Raises:** `InputError` naming the system of the pole.
    """
    if system.turn is None:
        return
    latitude = y * 360.0 / system.turn
    if np.nanmax(np.abs(latitude)) > farthest:
        middle = float(np.nanmean(latitude))
        raise InputError(
            f"the image is at the {'North' if middle > 0 else 'South'} Pole, latitude to "
            f"{np.nanmax(np.abs(latitude)):.4g}°, where a map in longitude and latitude falls "
            f"apart; give --crs {utm_system(middle, 0.0)} (Universal Polar Stereographic)"
        )


def contiguous(system: MapSystem, x: Float[np.ndarray, "r c"]) -> Float[np.ndarray, "r c"]:
    """x of a lattice of points, longitudes made contiguous about its middle.

    **Raises:** `InputError` if a projected system has its edge among the points.
    """
    finite = np.flatnonzero(np.isfinite(x))
    if not len(finite):
        return x
    # The one nearest to the middle of the lattice that has a place.
    middle = x.ravel()[finite[np.abs(finite - x.size // 2).argmin()]]
    x = system.unwrap(x, float(middle))
    if system.transformer and system.turn is None:
        steps = [np.abs(np.diff(x, axis=axis)).ravel() for axis in (0, 1)]
        longest = np.nanmax(np.concatenate([np.zeros(1), *steps]))
        # Neighbours of a lattice of some 30 points are a thirtieth of the extent apart; those on
        # both sides of an edge are nearly all of it. A quarter lies between.
        if longest > 0.25 * (np.nanmax(x) - np.nanmin(x)):
            raise InputError(
                f"coordinate system {system.crs}: the image lies on both sides of its edge (x "
                f"jumps by {longest:.6g}); give a system with its middle there, such as EPSG:3832 "
                "at 180°, the zone of UTM, or omit it: longitude and latitude"
            )
    return x


def grid_around(x: np.ndarray, y: np.ndarray, size: float, max_pixels: float = np.inf) -> MapGrid:
    """The pixels of this size that cover all points, with edges at multiples of it.

    **Raises:** `InputError` for more than `max_pixels`, or too many rows or columns for a
    GeoTIFF."""
    left, right = np.floor(np.nanmin(x) / size), np.ceil(np.nanmax(x) / size)
    bottom, top = np.floor(np.nanmin(y) / size), np.ceil(np.nanmax(y) / size)
    columns, rows = right - left, top - bottom
    # GDAL counts rows and columns by 32 bits with a sign
    if not (max(rows, columns) < np.iinfo(np.int32).max and rows * columns <= max_pixels):
        raise InputError(
            f"--spacing {size:g}: the map would have {rows:.3g} × {columns:.3g} pixels; give a "
            "larger one, in the unit of the map, or another --crs"
        )
    return MapGrid(left * size, top * size, size, int(columns), int(rows))


def _transformer(crs: str) -> tuple["Transformer", float | None]:
    """The transformation from degrees to a system, and the change of x in a turn."""
    try:
        import pyproj.exceptions
    except ImportError:
        raise InputError("coordinate systems need pyproj: pip install 'jaxbundle[geo]'") from None
    try:
        system = pyproj.CRS.from_user_input(crs)
        if not (system.is_geographic or system.is_projected):
            raise InputError(
                f"coordinate system {crs!r} ({system.name}): {system.type_name} is not for maps; "
                "give a projected one, such as EPSG:32633, or a geographic one, such as EPSG:4326"
            )
        transformer = pyproj.Transformer.from_crs("EPSG:4326", system, always_xy=True)
    except pyproj.exceptions.ProjError as error:
        raise InputError(f"coordinate system {crs!r}: {' '.join(str(error).split())}") from None
    if not system.is_geographic:
        return transformer, None
    return transformer, 2 * np.pi / system.axis_info[0].unit_conversion_factor  # in its unit
