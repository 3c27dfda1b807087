"""What the values of a terrain model are: scale and offset of its band, unit and direction of its
vertical system, and whether heights are above an ellipsoid or a geoid.

A system of three axes (EPSG:4979) has heights above its ellipsoid; a compound one, such as
EPSG:4326+5773, heights of its vertical part, which are above a geoid or a tide gauge.
"""

from pathlib import Path
from typing import Any, NamedTuple

from jaxbundle.errors import InputError
from jaxbundle.system.foreign_parsers import foreign_parser

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
        grid = GRIDS.get(code or 0, USUAL)
        raise InputError(
            f"{path}: its heights are those of {vertical.name!r}, not above the ellipsoid; give "
            f"the geoid: --geoid {grid} (a grid of PROJ: projsync --file {grid}), or, if they are "
            "above the ellipsoid nevertheless, a copy without the vertical system (gdal_translate "
            f"-a_srs {_horizontal(system)})"
        )
    if vertical is None and above_geoid:
        raise InputError(
            f"{path}: its heights are above the ellipsoid, by its system {system.name!r}; omit "
            "--geoid"
        )
    factor = axes[0].unit_conversion_factor * (-1 if axes[0].direction == "down" else 1)
    return HeightScale(factor * height.scale, factor * height.offset)


def _horizontal(system: Any) -> str:
    parts = [part for part in system.sub_crs_list if not part.is_vertical]
    code = parts[0].to_epsg() if parts else None
    return f"EPSG:{code or 4326}"
