"""Coordinates of maps: pyproj's systems, and grids of pixels in them."""

from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Float

from jaxbundle.errors import InputError
from jaxbundle.geometry.ellipsoid import Ellipsoid, geodetic
from jaxbundle.pushbroom.correct import Nodes, geographic_nodes, local_nodes
from jaxbundle.pushbroom.surfaces import Surface

_geodetic = jax.jit(geodetic)


class MapSystem:
    """A coordinate system of maps, for points of an Earth or of a local frame.

    `crs` is anything pyproj reads, such as `"EPSG:32633"`; None: longitude and latitude in degrees,
    or X and Y of the local frame.

    **Raises:** `InputError` for what pyproj does not know.
    """

    def __init__(self, earth: Ellipsoid | None, crs: str | None):
        self.earth, self.crs = earth, crs
        self.transformer = None
        if earth is None and crs is not None:
            raise InputError(f"coordinate system {crs}: a local frame has none; leave it away")
        if earth is not None and crs is not None:
            self.transformer = _transformer(crs)

    def from_ground(self, X: Float[np.ndarray, "3 *shape"]) -> tuple[np.ndarray, np.ndarray]:
        """x and y of points of the ground."""
        if self.earth is None:
            return X[0], X[1]
        longitude, latitude, _ = _geodetic(self.earth, tuple(X))
        degrees = np.degrees(np.asarray(longitude)), np.degrees(np.asarray(latitude))
        return self.transformer.transform(*degrees) if self.transformer else degrees

    def nodes(self, surface: Surface, x: np.ndarray, y: np.ndarray) -> Nodes:
        """Ground points at x and y."""
        if self.earth is None:
            return local_nodes(x, y)
        if self.transformer:
            x, y = self.transformer.transform(x, y, direction="INVERSE")
        return geographic_nodes(surface, np.radians(x), np.radians(y))

    @property
    def text(self) -> str | None:
        """As rasterio writes it."""
        return self.crs if self.crs or self.earth is None else "EPSG:4326"


class MapGrid(NamedTuple):
    """Pixels of a map, north up: the outer corner (x, y) of the first one, their size."""

    x: float
    y: float
    size: float
    columns: int
    rows: int

    def centres(self, row: Float[np.ndarray, " r"], column: Float[np.ndarray, " c"]):
        """x and y of the centres of rows × columns."""
        return np.meshgrid(
            self.x + (column + 0.5) * self.size, self.y - (row + 0.5) * self.size
        )

    def place(self, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Row and column, whole numbers at the centres, of map coordinates."""
        return (self.y - y) / self.size - 0.5, (x - self.x) / self.size - 0.5


def grid_around(x: np.ndarray, y: np.ndarray, size: float) -> MapGrid:
    """The pixels of this size that hold all places, their edges at multiples of it.

    **Raises:** `InputError` if there are none.
    """
    if not np.isfinite(x).any():
        raise InputError("no point of the image is on the ground; look at attitude and mounting")
    left, right = np.floor(np.nanmin(x) / size), np.ceil(np.nanmax(x) / size)
    bottom, top = np.floor(np.nanmin(y) / size), np.ceil(np.nanmax(y) / size)
    return MapGrid(left * size, top * size, size, int(right - left), int(top - bottom))


def _transformer(crs):
    try:
        import pyproj
    except ImportError:
        raise InputError("coordinate systems need pyproj: pip install 'jaxbundle[geo]'") from None
    try:
        return pyproj.Transformer.from_crs("EPSG:4326", crs, always_xy=True)
    except pyproj.exceptions.CRSError as error:
        raise InputError(f"coordinate system {crs!r}: {' '.join(str(error).split())}") from None
