"""Positions in a map system, from photographs and control files.

Latitude and longitude become coordinates of the UTM zone with most of them. Heights are
unchanged: above sea level by EXIF, but many drones write them above the ellipsoid or above
the take-off point, so the assumed reference is reported with them.
"""

import importlib.util
import re
from collections.abc import Sequence
from types import ModuleType
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from jaxbundle.errors import InputError
from jaxbundle.photographs.exif import GeographicPosition

# Default σ of satellite positions, metres: GPS promises 8 m in the plane and 13 m in height at 95 %
# (Standard Positioning Service, 2020), which are σ of 3.3 and 6.6 m a coordinate. They count only
# where the file states none.
SIGMA, SIGMA_HEIGHT = 3.0, 6.0


class MapPositions(NamedTuple):
    """Positions and their σ, metres, NaN: unknown; meridian convergence there, degrees;
    the name of the system; whether they extend far enough to define the frame of a block."""

    X: Float[np.ndarray, "n 3"]
    sigma: Float[np.ndarray, "n 3"]
    convergence: Float[np.ndarray, " n"]
    system: str
    define_frame: bool = True

    @property
    def words(self) -> str:
        """The system and the reference of the heights."""
        return f"{self.system}, heights as the files have them (EXIF: above sea level)"


def utm_system(latitude: float, longitude: float) -> str:
    """The EPSG code of the zone of UTM of a place; beyond 84° N and 80° S, where these end, of the
    Universal Polar Stereographic system (NGA.STND.0037)."""
    if not -80 <= latitude <= 84:
        return "EPSG:32661" if latitude > 0 else "EPSG:32761"
    zone = int((longitude + 180) // 6) % 60 + 1
    # 326zz north, 327zz south of the equator (EPSG registry, WGS 84 / UTM)
    return f"EPSG:{(32600 if latitude >= 0 else 32700) + zone}"


def map_positions(
    places: Sequence[GeographicPosition | None], system: str = ""
) -> MapPositions | None:
    """Positions in a projected system in metres, default the UTM zone; None if they are fewer than
    three, or the system has another unit."""
    located = [(k, p) for k, p in enumerate(places) if p is not None and p.height is not None]
    if len(located) < 3:
        return None
    rows, known_places = [k for k, _ in located], [place for _, place in located]
    latitude = np.array([p.latitude for p in known_places])
    longitude = np.array([p.longitude for p in known_places])
    system = system or _utm_system_of_most(latitude, longitude)
    axis = _need_pyproj().CRS.from_user_input(system).axis_info[0]
    if axis.unit_conversion_factor != 1:
        return None
    x, y = _transformer("EPSG:4326", system, "positions").transform(longitude, latitude)
    height = np.array([p.height for p in known_places], float)
    sigma = np.array([p.sigma or SIGMA for p in known_places])
    extent = np.hypot(np.ptp(x), np.ptp(y))
    X, s = np.full((len(places), 3), np.nan), np.full((len(places), 3), np.nan)
    X[rows] = np.stack([x, y, height], 1)
    height_sigmas = [
        p.sigma_height or plane * SIGMA_HEIGHT / SIGMA for p, plane in zip(known_places, sigma)
    ]
    s[rows] = np.stack([sigma, sigma, height_sigmas], 1)
    convergence = np.full(len(places), np.nan)
    factors = _need_pyproj().Proj(system).get_factors(longitude, latitude)
    convergence[rows] = factors.meridian_convergence
    # Over 8 σ three positions determine the direction to √2·σ/8σ = 10 degrees and the scale to 18 %
    is_wide = bool(extent > 8 * np.median(sigma))
    return MapPositions(X, s, convergence, system, is_wide)


def to_map(
    X: Float[np.ndarray, "n 3"], system: str, where: str
) -> tuple[Float[np.ndarray, "n 3"], str]:
    """Coordinates in a map system; degrees are converted to UTM. Returns also the system's name.

    **Raises:** `InputError` for a system unknown to pyproj.
    """
    if not system:
        return X, ""
    zone = re.fullmatch(r"WGS84 +UTM +(\d+) *([NS])", system.strip(), re.IGNORECASE)
    if zone:
        system = f"EPSG:{(32600 if zone[2].upper() == 'N' else 32700) + int(zone[1])}"
        # It is known without pyproj, which only finds exchanged axes.
        if importlib.util.find_spec("pyproj") is None:
            return X, system
    pyproj = _need_pyproj()
    try:
        crs = pyproj.CRS.from_user_input("EPSG:4326" if system.upper() == "WGS84" else system)
    except pyproj.exceptions.ProjError:
        raise InputError(f"{where}: coordinate system {system!r} is not known") from None
    if not crs.is_geographic:
        code = crs.to_epsg()
        for axis in (axis for axis in crs.axis_info if axis.unit_conversion_factor != 1):
            raise InputError(
                f"{where}: {system} is in {axis.unit_name} ({axis.unit_conversion_factor:.9g} m); "
                "σ and distances are metres here: give the coordinates in a system in metres, such "
                "as the UTM zone"
            )
        # Other descriptions than the code do not have its area.
        crs = pyproj.CRS.from_epsg(code) if code else crs
        if not _is_in_area(X[:, :2], crs) and _is_in_area(X[:, 1::-1], crs):
            raise InputError(
                f"{where}: {X[0, 0]:.10g}, {X[0, 1]:.10g} lies outside of {system}, and within it "
                "the other way round: expected X (easting), then Y (northing)"
            )
        return X, f"EPSG:{code}" if code else crs.to_string()
    # Longitudes count from −180° or from 0°: up to 360.
    outside = (abs(X[:, 1]) > 90) | (abs(X[:, 0]) > 360)
    for longitude, latitude, _ in X[outside]:
        raise InputError(
            f"{where}: {longitude:g}, {latitude:g} is no place in {system}: expected longitude, "
            "then latitude, in degrees"
        )
    target = _utm_system_of_most(X[:, 1], X[:, 0])
    x, y = _transformer(crs, target, where).transform(X[:, 0], X[:, 1])
    return np.stack([x, y, X[:, 2]], 1), target


def _utm_system_of_most(
    latitude: Float[np.ndarray, " n"], longitude: Float[np.ndarray, " n"]
) -> str:
    """The system of the median place."""
    # Across the meridian of 180° longitudes jump by 360°, their differences do not.
    east_of_first = (longitude - longitude[0] + 180) % 360 - 180
    return utm_system(float(np.median(latitude)), float(longitude[0] + np.median(east_of_first)))


def _is_in_area(xy: Float[np.ndarray, "n 2"], crs: Any) -> bool:
    """Whether most places are in the area of use of a system; true where that is not known."""
    area = crs.area_of_use
    if area is None:
        return True
    # Coordinates continue into the neighbouring zone, of six degrees in UTM.
    margin, number = 6.0, len(xy)
    # Infinite where the projection has no such place.
    longitude, latitude = _transformer(crs, "EPSG:4326", "control").transform(*xy.T)
    with np.errstate(invalid="ignore"):
        from_west = np.mod(np.asarray(longitude) - area.west + margin, 360)
    width = np.mod(area.east - area.west, 360) or 360.0
    middle, half = (area.south + area.north) / 2, (area.north - area.south) / 2
    is_inside = (from_west <= width + 2 * margin) & (abs(latitude - middle) <= half + margin)
    return 2 * int(is_inside.sum()) > number


def _transformer(source: Any, target: str, where: str) -> Any:
    pyproj = _need_pyproj()
    try:
        return pyproj.Transformer.from_crs(source, target, always_xy=True)
    except pyproj.exceptions.ProjError as error:
        raise InputError(f"{where}: {error}") from None


def _need_pyproj() -> ModuleType:
    try:
        import pyproj
        import pyproj.exceptions
    except ImportError:
        raise InputError("map coordinates need pyproj: pip install 'jaxbundle[geo]'") from None
    return pyproj
