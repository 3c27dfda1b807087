"""Terrain models as rasters: heights above the ellipsoid or a geoid, in any coordinate system."""

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float

from jaxbundle.errors import InputError
from jaxbundle.geometry.ellipsoid import Ellipsoid
from jaxbundle.io.rasters.extent import Extent
from jaxbundle.io.rasters.mosaics import as_one_raster
from jaxbundle.io.rasters.vertical import KNOWN_SYSTEM, HeightScale, with_vertical_unit
from jaxbundle.pushbroom.terrain import Terrain, make_terrain
from jaxbundle.system.file_content import naming_file
from jaxbundle.system.foreign_parsers import foreign_parser
from jaxbundle.system.rasters import (
    GEOGRAPHIC,
    check_georeference,
    open_raster,
    raster_parser,
    rasterio,
    read_values,
)

if TYPE_CHECKING:
    from rasterio.io import DatasetReader
    from rasterio.vrt import WarpedVRT


def read_terrain(
    path: str | Path,
    earth: Ellipsoid | None,
    extent: Extent | None = None,
    above_geoid: bool = False,
) -> Terrain:
    """The terrain model of the first band of a raster, or of a folder of tiles; its heights are
    those above `earth`.

    Scale, offset and no-data of the band are applied, and so is the unit of a vertical system. A
    projected system is resampled to longitude and latitude first (bilinear, about the same
    spacing). With `earth` None its x and y are those of the local frame. Otherwise
    only the `extent` is read.

    **Arguments:** `above_geoid`: the caller will add the geoid (`add_geoid`).

    **Raises:** `InputError` if it cannot be read, has no georeference, or no heights in the extent;
    for a vertical system of heights above a geoid that nobody adds.
    """
    package = rasterio()
    from rasterio.vrt import WarpedVRT as Warped

    with as_one_raster(path) as file, open_raster(file) as source:
        check_georeference(path, source)
        height = HeightScale(source.scales[0], source.offsets[0])
        if earth is None:
            return _read_terrain(source, earth, path, extent, height)
        if source.crs is None:
            raise InputError(
                f"{path}: the raster has no coordinate system; add one, such as with "
                "gdal_translate -a_srs EPSG:4326"
            )
        height = with_vertical_unit(path, source.crs.to_wkt(), height, above_geoid)
        if source.crs.is_geographic:
            return _read_terrain(source, earth, path, extent, height)
        degrees = _degrees_around(path, source)

        def warp(kind: str) -> "WarpedVRT":
            with raster_parser(path):
                return Warped(
                    source,
                    crs=degrees,
                    dtype="float64",
                    nodata=np.nan,
                    resampling=package.enums.Resampling[kind],
                )

        with warp("bilinear") as warped, warp("nearest") as exact:
            return _read_terrain(warped, earth, path, extent, height, exact)


def _degrees_around(path: str | Path, source: "DatasetReader") -> str:
    """Longitude and latitude with the jump of longitudes opposite to a raster."""
    import pyproj

    left, bottom, right, top = source.bounds
    with foreign_parser(path, KNOWN_SYSTEM):
        to_geographic = pyproj.Transformer.from_crs(source.crs.to_wkt(), GEOGRAPHIC, always_xy=True)
        middle, _ = to_geographic.transform((left + right) / 2, (bottom + top) / 2)
    return (
        f"+proj=longlat +datum=WGS84 +lon_wrap={middle:.0f}"
        if np.isfinite(middle)
        else (GEOGRAPHIC)
    )


def _read_terrain(
    source: "DatasetReader",
    earth: Ellipsoid | None,
    path: str | Path,
    extent: Extent | None,
    height: HeightScale,
    exact: "DatasetReader | WarpedVRT | None" = None,
) -> Terrain:
    """The terrain model of a raster, whole or the `extent` of it; `exact`: with the same cells and
    the values of the file, where those of the raster are interpolated."""
    transform = source.transform
    if transform.b or transform.d:
        raise InputError(f"{path}: the raster is rotated; make it north up with gdalwarp")
    step = transform.a, transform.e
    read_heights = lambda source: (
        (_heights(path, source, None, height), (0, 0))
        if earth is None or extent is None
        else _read_extent(source, path, extent, height)
    )
    heights, first_cell = read_heights(source)
    if _has_strange_heights(heights):
        _refuse_undeclared_no_data(
            path, heights if exact is None else read_heights(exact)[0], height
        )
    unit = 1.0 if earth is None else np.pi / 180
    x, y = (
        transform.c + (first_cell[1] + 0.5) * step[0],
        transform.f + (first_cell[0] + 0.5) * step[1],
    )
    if not np.isfinite(heights).any():
        area = "" if extent is None else f" where the image looks, {extent}"
        raise InputError(f"{path}: no height{area}; give a model that covers the image")
    with naming_file(path):
        return make_terrain(heights, (unit * x, unit * y), (unit * step[0], unit * step[1]), earth)


def _has_strange_heights(
    heights: Float[np.ndarray, "rows columns"], lowest: float = -500.0, highest: float = 9000.0
) -> bool:
    """Whether there are heights below or above all land of the Earth (−430 m, 8849 m), metres."""
    return bool((heights < lowest).any() or (heights > highest).any())


def _refuse_undeclared_no_data(
    path: str | Path,
    heights: Float[np.ndarray, "rows columns"],
    height: HeightScale,
    gap: float = 1000.0,
) -> None:
    """Refuse a mark of cells without height, such as −9999, that a file does not declare: a height
    that no land has, far from every other.

    **Arguments:** `gap`: metres to the next height. Deep sea and high mountains of other bodies
    have heights between.
    """
    finite_heights = heights[np.isfinite(heights)]
    for end, sign in ((finite_heights.min(), 1.0), (finite_heights.max(), -1.0)):
        other_heights = finite_heights[finite_heights != end]
        if not len(other_heights):
            return
        nearest = other_heights.min() if sign > 0 else other_heights.max()
        if sign * (nearest - end) > gap and _has_strange_heights(end[None, None]):
            mark = (end - height.offset) / height.scale
            raise InputError(
                f"{path}: {len(finite_heights) - len(other_heights)} of {len(finite_heights)} "
                f"cells have the height {end:.10g}, the others {other_heights.min():.6g} to "
                f"{other_heights.max():.6g}; if it marks cells without height, declare it: "
                f"gdal_edit.py -a_nodata {mark:.10g} FILE"
            )


def _read_extent(
    source: "DatasetReader", path: str | Path, extent: Extent, height: HeightScale
) -> tuple[Float[np.ndarray, "rows columns"], tuple[int, int]]:
    """The heights of the extent and a cell around it, and the row and column of the first."""
    (dx, dy), (x0, y0) = (source.transform.a, source.transform.e), source.transform[2:6:3]
    rows, columns = source.shape
    bounds = source.bounds
    # Rows count from the north, or from the south.
    y = np.sort([(v - y0) / dy for v in (extent.south, extent.north)])
    first_row, end_row = max(int(np.floor(y[0])) - 2, 0), min(int(np.ceil(y[1])) + 2, rows)
    columns_per_turn = 360 / abs(dx)
    # The turn that brings the extent nearest to the raster.
    middle = ((extent.west + extent.east) / 2 - x0) / dx
    shift = columns_per_turn * np.round((columns / 2 - middle) / columns_per_turn)
    x = np.sort([(v - x0) / dx + shift for v in (extent.west, extent.east)])
    first_column, end_column = int(np.floor(x[0])) - 2, int(np.ceil(x[1])) + 2
    # 1e-3 columns: the spacing in the file has some ten digits
    seam = abs(columns_per_turn - columns) < 1e-3 and (first_column < 0 or end_column > columns)
    if not (seam and end_column - first_column < columns):
        seam, first_column, end_column = False, max(first_column, 0), min(end_column, columns)
    if min(end_column - first_column, end_row - first_row) < 2:
        model_extent = Extent(bounds.left, min(bounds[1::2]), bounds.right, max(bounds[1::2]))
        raise InputError(
            f"{path}: the model has {model_extent}; the image looks at {extent}: give a model that "
            "covers the image"
        )
    # The last column of a model of the whole Earth is beside its first.
    parts = (
        [(first_column % columns, columns), (0, end_column % columns)]
        if seam
        else [(first_column, end_column)]
    )
    heights = [_heights(path, source, ((first_row, end_row), part), height) for part in parts]
    return np.concatenate(heights, axis=1), (first_row, first_column)


def _heights(
    path: str | Path,
    source: "DatasetReader",
    window: tuple[tuple[int, int], tuple[int, int]] | None,
    height: HeightScale,
) -> Float[np.ndarray, "rows columns"]:
    values = read_values(path, source, 1, window)
    return height.scale * values + height.offset
