"""Rasters through rasterio: terrain models, and what all readers and writers share."""

import warnings
from pathlib import Path

import numpy as np

from jaxbundle.errors import InputError
from jaxbundle.geometry.ellipsoid import Ellipsoid
from jaxbundle.pushbroom.terrain import Terrain, make_terrain

GEOGRAPHIC = "EPSG:4326"


def rasterio():
    """The package, or an error that names the extra."""
    try:
        import rasterio
    except ImportError:
        raise InputError("rasters need rasterio: pip install 'jaxbundle[geo]'") from None
    return rasterio


def unreadable(path: str | Path, error: Exception) -> InputError:
    """What rasterio says about a file, in one line."""
    return InputError(f"{path}: {' '.join(str(error).split())}")


def open_plain(path: str | Path, *arguments, **options):
    """As `rasterio.open`; an image without georeference is what is expected, and not warned of."""
    package = rasterio()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", package.errors.NotGeoreferencedWarning)
        return package.open(path, *arguments, **options)


def as_type(values: np.ndarray, dtype: np.dtype | str) -> np.ndarray:
    """Values as they are stored: whole numbers are rounded and kept in range, NaN becomes 0."""
    if np.issubdtype(dtype, np.floating):
        return values.astype(dtype)
    limits = np.iinfo(dtype)
    return np.clip(np.rint(np.nan_to_num(values)), limits.min, limits.max).astype(dtype)


def read_terrain(path: str | Path, earth: Ellipsoid | None) -> Terrain:
    """The terrain model of the first band of a raster; its heights are those above `earth`.

    In a projected system it is brought to longitude and latitude first (bilinear, about the same
    spacing). With `earth` None its own x and y are those of the local frame.

    **Raises:** `InputError` if it cannot be read, has no georeference, or no heights.
    """
    package = rasterio()
    from rasterio.vrt import WarpedVRT

    try:
        with package.open(path) as source:
            if earth is None or (source.crs is not None and source.crs.is_geographic):
                return _terrain(source, earth, path)
            if source.crs is None:
                raise InputError(
                    f"{path}: the raster has no coordinate system; give one that has, such as by "
                    "gdal_translate -a_srs EPSG:4326"
                )
            with WarpedVRT(
                source, crs=GEOGRAPHIC, resampling=package.enums.Resampling.bilinear,
                dtype="float64", nodata=np.nan,
            ) as warped:  # fmt: skip
                return _terrain(warped, earth, path)
    except package.errors.RasterioError as error:
        raise unreadable(path, error) from None


def _terrain(source, earth, path):
    transform = source.transform
    if transform.b or transform.d:
        raise InputError(f"{path}: the raster is turned; bring it north up, by gdalwarp")
    heights = source.read(1, masked=True).astype(float).filled(np.nan)
    unit = 1.0 if earth is None else np.pi / 180
    step = transform.a, transform.e
    centre = transform.c + step[0] / 2, transform.f + step[1] / 2
    return make_terrain(
        heights, [unit * v for v in centre], [unit * v for v in step], earth
    )  # fmt: skip
