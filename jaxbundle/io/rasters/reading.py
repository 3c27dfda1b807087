"""Rasters through rasterio: terrain models, and functions common to readers and writers."""

import os
import warnings
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float

from jaxbundle.errors import InputError
from jaxbundle.geometry.ellipsoid import Ellipsoid
from jaxbundle.io.rasters.extent import Extent
from jaxbundle.pushbroom.terrain import Terrain, make_terrain
from jaxbundle.system.file_content import check_plain

if TYPE_CHECKING:
    from rasterio.io import DatasetReader

GEOGRAPHIC = "EPSG:4326"


def rasterio() -> ModuleType:
    """The package, or an error naming the extra."""
    try:
        import rasterio
        import rasterio.enums
        import rasterio.errors
        import rasterio.transform
    except ImportError:
        raise InputError("rasters need rasterio: pip install 'jaxbundle[geo]'") from None
    return rasterio


def unreadable(path: str | Path, error: Exception) -> InputError:
    """The message of rasterio about a file, in one line; what GDAL does not know is said as
    that."""
    if os.path.isdir(path):
        return InputError(f"{path}: is a folder; expected a raster, such as a GeoTIFF")
    said = " ".join(str(error).split())
    if "not recognized" in said:
        return InputError(f"{path}: expected a raster, such as a GeoTIFF; GDAL does not know it")
    return InputError(f"{path}: {said}")


def open_plain(path: str | Path, *arguments: str, **options: Any) -> Any:
    """As `rasterio.open`, without a warning about missing georeference."""
    package = rasterio()
    check_plain(path)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", package.errors.NotGeoreferencedWarning)
        return package.open(path, *arguments, **options)


def as_type(values: np.ndarray, dtype: np.dtype | str) -> np.ndarray:
    """Values as stored: whole numbers are rounded and clipped to the range, NaN becomes 0."""
    if np.issubdtype(dtype, np.floating):
        return values.astype(dtype)
    limits = np.iinfo(dtype)
    return np.clip(np.rint(np.nan_to_num(values)), limits.min, limits.max).astype(dtype)


def read_terrain(
    path: str | Path, earth: Ellipsoid | None, extent: Extent | None = None
) -> Terrain:
    """The terrain model of the first band of a raster; its heights are those above `earth`.

    A projected system is resampled to longitude and latitude first (bilinear, about the same
    spacing). With `earth` None its x and y are those of the local frame. Otherwise
    only the `extent` is read.

    **Raises:** `InputError` if it cannot be read, has no georeference, or no heights in the extent.
    """
    package = rasterio()
    check_plain(path)
    from rasterio.vrt import WarpedVRT

    try:
        with package.open(path) as source:
            if earth is None or (source.crs is not None and source.crs.is_geographic):
                return _terrain(source, earth, path, extent)
            if source.crs is None:
                raise InputError(
                    f"{path}: the raster has no coordinate system; add one, such as with "
                    "gdal_translate -a_srs EPSG:4326"
                )
            with WarpedVRT(
                source,
                crs=_degrees_around(source),
                dtype="float64",
                nodata=np.nan,
                resampling=package.enums.Resampling.bilinear,
            ) as warped:
                return _terrain(warped, earth, path, extent)
    except package.errors.RasterioError as error:
        raise unreadable(path, error) from None


def _degrees_around(source: "DatasetReader") -> str:
    """Longitude and latitude with the jump of longitudes opposite to a raster."""
    import pyproj

    left, bottom, right, top = source.bounds
    back = pyproj.Transformer.from_crs(source.crs.to_wkt(), GEOGRAPHIC, always_xy=True)
    middle, _ = back.transform((left + right) / 2, (bottom + top) / 2)
    return (
        f"+proj=longlat +datum=WGS84 +lon_wrap={middle:.0f}"
        if np.isfinite(middle)
        else (GEOGRAPHIC)
    )


def _terrain(
    source: "DatasetReader", earth: Ellipsoid | None, path: str | Path, extent: Extent | None
) -> Terrain:
    """The terrain model of a raster, whole or the `extent` of it."""
    transform = source.transform
    if transform.b or transform.d:
        raise InputError(f"{path}: the raster is rotated; make it north up with gdalwarp")
    step = transform.a, transform.e
    first = (0, 0)
    if earth is None or extent is None:
        heights = _heights(source, None)
    else:
        heights, first = _cut(source, path, extent)
    unit = 1.0 if earth is None else np.pi / 180
    x, y = transform.c + (first[1] + 0.5) * step[0], transform.f + (first[0] + 0.5) * step[1]
    if not np.isfinite(heights).any():
        there = "" if extent is None else f" where the image looks, {extent}"
        raise InputError(f"{path}: no height{there}; give a model that covers the image")
    return make_terrain(heights, (unit * x, unit * y), (unit * step[0], unit * step[1]), earth)


def _cut(
    source: "DatasetReader", path: str | Path, extent: Extent
) -> tuple[Float[np.ndarray, "rows columns"], tuple[int, int]]:
    """The heights of the extent and a cell around it, and the row and column of the first."""
    (dx, dy), (x0, y0) = (source.transform.a, source.transform.e), source.transform[2:6:3]
    rows, columns = source.shape
    bounds = source.bounds
    # rows count from the north, or from the south
    y = np.sort([(v - y0) / dy for v in (extent.south, extent.north)])
    top, bottom = max(int(np.floor(y[0])) - 2, 0), min(int(np.ceil(y[1])) + 2, rows)
    turn = 360 / abs(dx)
    # the turn that brings the extent nearest to the raster
    middle = ((extent.west + extent.east) / 2 - x0) / dx
    shift = turn * np.round((columns / 2 - middle) / turn)
    x = np.sort([(v - x0) / dx + shift for v in (extent.west, extent.east)])
    left, right = int(np.floor(x[0])) - 2, int(np.ceil(x[1])) + 2
    # 1e-3 columns: the spacing in the file has some ten digits
    seam = abs(turn - columns) < 1e-3 and (left < 0 or right > columns)
    if not (seam and right - left < columns):
        seam, left, right = False, max(left, 0), min(right, columns)
    if min(right - left, bottom - top) < 2:
        covered = Extent(bounds.left, min(bounds[1::2]), bounds.right, max(bounds[1::2]))
        raise InputError(
            f"{path}: the model has {covered}; the image looks at {extent}: give a model that "
            "covers the image"
        )
    # the last column of a model of the whole Earth is beside its first
    parts = [(left % columns, columns), (0, right % columns)] if seam else [(left, right)]
    heights = [_heights(source, ((top, bottom), part)) for part in parts]
    return np.concatenate(heights, axis=1), (top, left)


def _heights(
    source: "DatasetReader", window: tuple[tuple[int, int], tuple[int, int]] | None
) -> Float[np.ndarray, "rows columns"]:
    return source.read(1, window=window, masked=True).astype(float).filled(np.nan)
