"""Rasters through rasterio: what all who read and write them share."""

import os
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from jaxtyping import Float

from jaxbundle.errors import InputError
from jaxbundle.system.file_content import check_plain, naming_file
from jaxbundle.system.foreign_parsers import foreign_parser

if TYPE_CHECKING:
    from rasterio.io import DatasetReader

GEOGRAPHIC = "EPSG:4326"
EXPECTED = "a raster, such as a GeoTIFF"
# First row and the one after the last, first column and the one after the last.
Window = tuple[tuple[int, int], tuple[int, int]]


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


@contextmanager
def raster_parser(path: str | Path) -> Iterator[None]:
    """The context of a call of rasterio on a file; what GDAL does not know is said as that."""
    with naming_file(path):
        try:
            with foreign_parser(path, EXPECTED):
                yield
        except InputError as error:
            if "not recognized" in str(error):
                raise InputError(f"{path}: expected {EXPECTED}; GDAL cannot read it") from None
            raise


@contextmanager
def open_raster(path: str | Path) -> Iterator["DatasetReader"]:
    """A raster to read, without a warning about missing georeference.

    **Raises:** `InputError` if it is missing, a folder, or no raster."""
    package = rasterio()
    check_plain(path)
    if os.path.isdir(path):
        raise InputError(f"{path}: is a folder; expected {EXPECTED}")
    with raster_parser(path):
        source = open_plain(path)
    with source:
        # Imaging spectrometers have hundreds of bands; of a hundred thousand GDAL would think long.
        if not 1 <= source.count <= 4096:
            raise InputError(f"{path}: is damaged, or no image: it has {source.count} bands")
        try:
            yield source
        except package.errors.RasterioError as error:  # of a property that is read late
            raise InputError(f"{path}: is damaged: {' '.join(str(error).split())[:200]}") from None


def open_plain(path: str | Path, *arguments: str, **options: Any) -> Any:
    """As `rasterio.open`, without a warning about missing georeference."""
    package = rasterio()
    check_plain(path)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", package.errors.NotGeoreferencedWarning)
        return package.open(path, *arguments, **options)


def read_pixels(
    path: str | Path,
    source: "DatasetReader",
    bands: int | Sequence[int] | None = None,
    window: Window | None = None,
) -> np.ma.MaskedArray:
    """The stored values of bands, [rows, columns] of one and [bands, rows, columns] of several;
    no-data is masked.

    **Raises:** `InputError` if the file cannot be read, or as `check_pixels`."""
    check_pixels(path, source, [bands] if isinstance(bands, int) else bands, window)
    with raster_parser(path):
        return source.read(bands, window=window, masked=True)


def read_values(
    path: str | Path,
    source: "DatasetReader",
    bands: int | Sequence[int] | None = None,
    window: Window | None = None,
) -> np.ndarray:
    """As `read_pixels`, in double precision, NaN where there is no data."""
    values: Any = read_pixels(path, source, bands, window)
    return values.astype(float).filled(np.nan)


class HeightRaster(NamedTuple):
    """Heights [rows, columns], NaN for voids; the centre of the first cell and the steps along X of
    columns and along Y of rows, in the coordinates of its map; its coordinate system (WKT)."""

    heights: Float[np.ndarray, "rows columns"]
    origin: tuple[float, float]
    step: tuple[float, float]
    system: str | None
    geographic: bool


def read_heights(path: str | Path) -> HeightRaster:
    """The heights of the first band of a raster as it is, along its own axes, with the scale and
    offset of the band.

    **Raises:** `InputError` if it cannot be read, has no georeference, or is rotated."""
    with open_raster(path) as source:
        check_georeference(path, source)
        transform = source.transform
        if transform.b or transform.d:
            raise InputError(
                f"{path}: the raster is rotated; expected rows along X, columns along Y (gdalwarp)"
            )
        values = source.scales[0] * read_values(path, source, 1) + source.offsets[0]
        crs = source.crs
        return HeightRaster(
            values,
            # Heights are of the centres of cells.
            (transform.c + 0.5 * transform.a, transform.f + 0.5 * transform.e),
            (transform.a, transform.e),
            None if crs is None else crs.to_wkt(),
            crs is not None and crs.is_geographic,
        )


def read_plain(path: str | Path, source: "DatasetReader", window: Window) -> np.ndarray:
    """The stored values of all bands, without a look at no-data.

    **Raises:** as `read_pixels`."""
    check_pixels(path, source, None, window)
    with raster_parser(path):
        return source.read(window=window)


def check_pixels(
    path: str | Path,
    source: "DatasetReader",
    bands: Sequence[int] | None = None,
    window: Window | None = None,
    harmless: int = 2**28,
    ratio: int = 2000,
) -> None:
    """Refuse to make room for more values than a file can hold.

    **Arguments:** `harmless`: bytes that are always read; `ratio`: beyond them, bytes for one of
    the file: the densest packing of DEFLATE is 1032.

    **Raises:** `InputError`."""
    (first_row, end_row), (first_column, end_column) = window or (
        (0, source.height),
        (0, source.width),
    )
    size = sum(np.dtype(source.dtypes[k - 1]).itemsize for k in bands or source.indexes)
    needed, present = (
        (end_row - first_row) * (end_column - first_column) * size,
        os.path.getsize(path),
    )
    # A VRT is a text about other files.
    if needed > harmless and needed > ratio * present and source.driver != "VRT":
        raise InputError(
            f"{path}: is damaged, or nearly empty: {present} bytes that claim to hold {needed} of "
            f"{end_row - first_row} × {end_column - first_column} pixels"
        )


def check_georeference(path: str | Path, source: "DatasetReader") -> None:
    """Refuse one that is no number, beyond any map, or without an inverse.

    **Raises:** `InputError`."""
    # 1e9: degrees, metres or feet, of pixels up to the size of the Earth; 1e-12 degrees are 0.1 µm
    transform, area = tuple(source.transform)[:6], abs(source.transform.determinant)
    if not (all(abs(v) < 1e9 for v in transform) and area > 1e-24):
        raise InputError(
            f"{path}: is damaged: its georeference is {', '.join(f'{v:g}' for v in transform)}"
        )


def check_raw(path: str | Path, source: "DatasetReader") -> None:
    """Refuse a raster that is a map, or a crop, where one of the lines of a scanner is expected.

    **Raises:** `InputError`."""
    transform = source.transform
    remedy = "; give the whole image as the scanner took it, or the coefficients (RPC) of this one"
    if source.crs is not None and not transform.is_identity:
        raise InputError(
            f"{path}: is a map, in {source.crs.to_string()[:60]} with pixels of {transform.a:g}: "
            f"its rows are not the lines of the scanner{remedy}"
        )
    # GDAL's coordinates of pixels, rows downwards; programs leave them when they cut a part out
    steps = (transform.a, transform.b, transform.d, transform.e)
    if source.crs is None and steps == (1, 0, 0, 1) and not transform.is_identity:
        raise InputError(
            f"{path}: is a part that begins at line {transform.f:g}, pixel {transform.c:g} of a "
            f"larger image{remedy}"
        )


def as_type(values: np.ndarray, dtype: np.dtype | str, nodata: float | None = None) -> np.ndarray:
    """Values as stored: whole numbers are rounded and clipped to the range, NaN becomes `nodata`;
    None: NaN stays, and is 0 of whole numbers."""
    if np.issubdtype(dtype, np.floating):
        filled = values if nodata is None else np.where(np.isnan(values), nodata, values)
        return filled.astype(dtype)
    limits = np.iinfo(dtype)
    filled = np.where(np.isnan(values), nodata or 0, np.rint(values))
    return np.clip(filled, limits.min, limits.max).astype(dtype)
