"""What the values of a terrain model are: scale and offset of its band, unit and direction of its
vertical system, and whether heights are above an ellipsoid or a geoid; and the systems of models
that are written.

A system of three axes (EPSG:4979) has heights above its ellipsoid; a compound one, such as
EPSG:4326+5773, heights of its vertical part, which are above a geoid or a tide gauge.
"""

from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from jaxbundle.errors import InputError
from jaxbundle.system.foreign_parsers import foreign_parser

if TYPE_CHECKING:
    import pyproj

# PROJ's grid by the EPSG code of a vertical system (cdn.proj.org): EGM96, EGM2008, NAVD88, the
# German one.
GRIDS = {5773: "us_nga_egm96_15.tif", 5171: "us_nga_egm96_15.tif", 3855: "us_nga_egm08_25.tif",
         5703: "us_noaa_g2018u0.tif", 7837: "de_bkg_GCG2016.tif"}  # fmt: skip
KNOWN_SYSTEM = "a raster with a coordinate system that PROJ knows"
USUAL = "us_nga_egm96_15.tif"


class HeightScale(NamedTuple):
    """height = scale·value + offset, metres upwards."""

    scale: float = 1.0
    offset: float = 0.0


def with_vertical_unit(
    path: str | Path, wkt: str, height: HeightScale, above_geoid: bool
) -> HeightScale:
    """The scale of the heights of a raster in metres, upwards.

    **Arguments:** `height`: scale and offset of its band; `above_geoid`: undulations of a geoid
    will be added.

    **Raises:** `InputError` if the system has heights above a geoid and none is added, or heights
    above the ellipsoid and one is."""
    import pyproj

    with foreign_parser(path, KNOWN_SYSTEM):
        system = pyproj.CRS.from_wkt(wkt)
        axes = [axis for axis in system.axis_info if axis.direction in ("up", "down")]
        vertical: Any = next((part for part in system.sub_crs_list if part.is_vertical), None)
        code = None if vertical is None else vertical.to_epsg()
    if not axes:
        return height
    if vertical is not None and not above_geoid:
        grid = usual_grid(code)
        raise InputError(
            f"{path}: its heights are those of {vertical.name!r}, not above the ellipsoid; give "
            f"the geoid: --geoid {grid} (a grid of PROJ: projsync --file {grid}), or, if they are "
            "above the ellipsoid nevertheless, a copy without the vertical system (gdal_translate "
            f"-a_srs {_horizontal_system(system)})"
        )
    if vertical is None and above_geoid:
        raise InputError(
            f"{path}: its heights are above the ellipsoid, by its system {system.name!r}; omit "
            "--geoid"
        )
    factor = axes[0].unit_conversion_factor * (-1 if axes[0].direction == "down" else 1)
    return HeightScale(factor * height.scale, factor * height.offset)


def _horizontal_system(system: Any) -> str:
    parts = [part for part in system.sub_crs_list if not part.is_vertical]
    code = parts[0].to_epsg() if parts else None
    return f"EPSG:{code or 4326}"


def usual_grid(code: int | None) -> str:
    """PROJ's grid of the geoid of a vertical system, by its EPSG code; EGM96 of others."""
    return GRIDS.get(code or 0, USUAL)


class MapAndHeights(NamedTuple):
    """The parts of a coordinate system: of the map, as rasterio and pyproj read it; of the heights,
    None without one; whether it has heights above its ellipsoid."""

    horizontal: str
    vertical: "pyproj.CRS | None"
    above_ellipsoid: bool


def split_system(crs: str) -> MapAndHeights:
    """The map and the heights of a system.

    **Raises:** `InputError` for a system unknown to pyproj."""
    try:
        import pyproj
        import pyproj.exceptions
    except ImportError:
        raise InputError("coordinate systems need pyproj: pip install 'jaxbundle[geo]'") from None
    try:
        system = pyproj.CRS.from_user_input(crs)
    except pyproj.exceptions.ProjError as error:
        raise InputError(f"--crs {crs!r}: {' '.join(str(error).split())}") from None
    vertical = next((part for part in system.sub_crs_list if part.is_vertical), None)
    if vertical is None:
        three = len(system.axis_info) == 3
        return MapAndHeights(_short_name(system.to_2d()) if three else crs, None, three)
    horizontal = next(part for part in system.sub_crs_list if not part.is_vertical)
    return MapAndHeights(_short_name(horizontal), vertical, False)


def horizontal_system(crs: str | None) -> str | None:
    """The map of a system: of rasters whose values are no heights; None stays None."""
    return None if crs is None else split_system(crs).horizontal


def unit_of(crs: str) -> tuple[str, float | None]:
    """The unit of x and y of a system, and its metres; None for angles."""
    import pyproj

    system = pyproj.CRS.from_user_input(crs)
    axis = system.axis_info[0]
    return axis.unit_name, None if system.is_geographic else axis.unit_conversion_factor


def name_system(crs: str) -> str:
    """The name of the map of a system, such as "WGS 84 / UTM zone 32N"."""
    import pyproj

    return pyproj.CRS.from_user_input(split_system(crs).horizontal).name


def with_heights_above(horizontal: str, geoid: str | Path) -> str:
    """The system of a map with heights above a geoid: of EPSG where its grid is one of PROJ's that
    belong to one, else one with the name of the grid."""
    import pyproj

    name = Path(geoid).name
    code = next((code for code, grid in GRIDS.items() if grid == name), None)
    map_system = pyproj.CRS.from_user_input(horizontal)
    if code is not None:
        authority = map_system.to_authority(min_confidence=100)
        vertical = pyproj.CRS.from_epsg(code)
        if authority is not None:
            return f"{':'.join(authority)}+{code}"
    else:
        quoted = name.replace('"', '""')
        vertical = pyproj.CRS.from_wkt(
            f'VERTCRS["height above the geoid {quoted}",VDATUM["geoid {quoted}"],CS[vertical,1],'
            'AXIS["gravity-related height (H)",up],LENGTHUNIT["metre",1]]'
        )
    parts = f"{map_system.name} + {vertical.name}".replace('"', '""')
    return f'COMPOUNDCRS["{parts}",{map_system.to_wkt()},{vertical.to_wkt()}]'


def _short_name(system: Any) -> str:
    """A system by its code, if it is exactly that, else in WKT."""
    code = system.to_authority(min_confidence=100)
    return system.to_wkt() if code is None else ":".join(code)
