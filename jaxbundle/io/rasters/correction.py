"""A raster corrected to a map: GeoTIFF, block by block, a few blocks in memory at a time."""

import dataclasses
import itertools
import threading
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Num

from jaxbundle.choices import Resampling
from jaxbundle.errors import InputError
from jaxbundle.io.rasters.checkpoints import Checkpoint
from jaxbundle.io.rasters.map_blocks import PLAIN, MapBands, MapFormat, write_map
from jaxbundle.io.rasters.maps import (
    MapGrid,
    MapSystem,
    check_away_from_poles,
    contiguous,
    grid_around,
)
from jaxbundle.pushbroom.ground_to_image import Search
from jaxbundle.pushbroom.image import PushbroomImage
from jaxbundle.pushbroom.image_to_ground import locate_lines
from jaxbundle.pushbroom.rectification import (
    BLOCK_SIZE,
    TOLERANCE,
    MapNodes,
    Places,
    block_places,
)
from jaxbundle.pushbroom.resampling import REACH, resample_pixels, working_type
from jaxbundle.pushbroom.rpc.image import RpcImage, locate_rpc_lines
from jaxbundle.pushbroom.surfaces import GroundSurface
from jaxbundle.pushbroom.terrain import Terrain
from jaxbundle.system.programs import compile_once
from jaxbundle.system.rasters import (
    Window,
    as_type,
    check_raw,
    open_raster,
    rasterio,
    read_plain,
    read_values,
)
from jaxbundle.types import AnyArray, Progress, Scalar

if TYPE_CHECKING:
    from rasterio.io import DatasetReader

# Rows and columns of a block.
Part = tuple[slice, slice]

_locate = compile_once(locate_lines, ())
_locate_rpc = compile_once(locate_rpc_lines, ())


def map_of(
    image: PushbroomImage | RpcImage,
    surface: GroundSurface,
    system: MapSystem,
    size: float | None,
    model: str | Path | None = None,
    border: int = 33,
    max_pixels: float = 10_000,
    tell: Callable[[str], object] = lambda _: None,
) -> MapGrid:
    """The pixels of a map of the whole image, by default with its size on the ground.

    **Arguments:** `model` names the file of a terrain in messages; `border`: points along each
    border of the image that bound the map, enough for the bends of a track and of a terrain: what
    they miss is cut off, except for the margin of a pixel; `max_pixels` of the map for one of the
    image: more indicate a wrong spacing, such as metres where the map is in degrees; `tell`: called
    if a terrain model does not have the whole ground of the image.

    **Raises:** `InputError` if the image shows nothing of the surface, its map does not hold
    together, or is too large.
    """
    lines = np.linspace(-0.5, image.lines - 0.5, border)
    pixels = np.linspace(-0.5, image.pixels - 0.5, border)
    inner = np.clip(lines, 0, image.lines - 1)  # the tables may end at the outer lines' centres
    locate = _locate_rpc if isinstance(image, RpcImage) else _locate
    X = np.asarray(locate(image, surface, inner, pixels))
    if not np.isfinite(X).any():
        raise InputError(
            f"{model or 'terrain'}: no height where the image looks; give a model that covers it"
            if isinstance(surface, Terrain)
            else "no point of the image is on the ground; check attitude and mounting"
        )
    covered_share = np.mean(np.isfinite(X).all(0))
    if isinstance(surface, Terrain) and covered_share < 1:
        tell(
            f"{model or 'terrain'}: no height for {100 * (1 - covered_share):.2g} % of the image "
            f"({X[0].size} positions): the map has no data there, or ends; give a model that "
            "covers the image"
        )
    x, y = system.from_ground(X)
    if not np.isfinite(x).any():
        raise InputError(f"coordinate system {system.crs}: it is not defined where the image is")
    check_away_from_poles(system, y)
    x = contiguous(system, x)
    if size is None:
        rows = np.hypot(np.diff(x, axis=0), np.diff(y, axis=0)) / np.diff(inner)[:, None]
        columns = np.hypot(np.diff(x, axis=1), np.diff(y, axis=1)) / np.diff(pixels)
        # Two digits: a round size that a reader can repeat.
        size = float(f"{min(np.nanmedian(rows), np.nanmedian(columns)):.2g}")
    elif size > (extent := max(np.nanmax(v) - np.nanmin(v) for v in (x, y))):
        raise InputError(
            f"--spacing {size:g}: larger than the whole image, {extent:.3g} {system.unit}; give a "
            "smaller one, in the unit of the map, or another --crs"
        )
    grid = grid_around(x, y, size, max_pixels * image.lines * image.pixels)
    # A line beyond the outermost centres, outside the border.
    return MapGrid(grid.x - size, grid.y + size, size, grid.columns + 2, grid.rows + 2)


@dataclasses.dataclass(frozen=True)
class Correction:
    """How an image is corrected: kernel, `tolerance` of interpolated positions (pixels of the
    image), whether hidden terrain has no data, and the value of no data (None: that of the image,
    NaN, or 0 of whole numbers)."""

    resampling: Resampling = "bilinear"
    occlusion: bool = False
    tolerance: float = TOLERANCE
    nodata: float | None = None


BILINEAR = Correction()


def write_corrected(
    source: str | Path,
    target: str | Path,
    image: PushbroomImage | RpcImage,
    search: Search | None,
    surface: GroundSurface,
    system: MapSystem,
    grid: MapGrid,
    correction: Correction = BILINEAR,
    progress: Progress | None = None,
    stored: tuple[MapFormat, Checkpoint | None] = (PLAIN, None),
) -> None:
    """Write the raster `source`, taken by the image, as the map `target`.

    All bands, in the type of the source, with its scales and offsets; no data outside the image,
    where the source has no data, and, with `occlusion`, also for hidden terrain. Where the value of
    no data is that of the source or a given one, pixels that show it by chance have the nearest
    other value; else 0 of the source, which may be its undeclared border, is no data of the map.

    **Arguments:** `stored`: the format of the map, and its checkpoint.

    **Raises:** `InputError` if the raster does not have the size of the image, or cannot be read.
    """
    # 256 MB of GDAL's blocks: those of a row of blocks of the map, of an image in tiles; by default
    # they grow to 5 % of the memory of the machine
    with rasterio().Env(GDAL_CACHEMAX=256), open_raster(source) as bands:
        if not isinstance(image, RpcImage):
            check_raw(source, bands)
        if (bands.height, bands.width) != (image.lines, image.pixels):
            raise InputError(
                f"{source}: {bands.height} lines of {bands.width} pixels; the "
                f"{'image of the RPC' if isinstance(image, RpcImage) else 'scanner file'} has "
                f"{image.lines} of {image.pixels}"
            )
        pixels = _SourcePixels(source, bands, correction)

        def block(nodes: MapNodes) -> np.ndarray | None:
            geometry = image, search, surface, nodes
            places = block_places(*geometry, correction.occlusion, correction.tolerance)
            return None if places is None else pixels.values_at(image, places)

        format, checkpoint = stored
        write_map(target, system, grid, surface, pixels.bands, block, progress, format, checkpoint)


class _SourcePixels:
    """The pixels of a raster, resampled for blocks of a map; from several threads.

    **Raises:** `InputError` if its bands are of several types, of complex numbers, or if the value
    of no data is none of their type.
    """

    def __init__(self, path: str | Path, raster: "DatasetReader", correction: Correction):
        self._path, self._raster = path, raster
        self._kind: Resampling = correction.resampling
        self._reading = threading.Lock()  # GDAL: one thread at a time in a data set
        dtype = np.dtype(raster.dtypes[0])
        if dtype.kind not in "uif" or len(set(raster.dtypes)) > 1:
            raise InputError(
                f"{path}: bands of {', '.join(dict.fromkeys(raster.dtypes))}; expected all of one "
                "type, of whole or floating point numbers: convert them with gdal_translate -ot, "
                "or correct each band alone"
            )
        flags = raster.mask_flag_enums
        values = set(raster.nodatavals)
        self._missing = next(iter(values)) if len(values) == 1 else None
        all_nodata = all([flag.name for flag in band] == ["nodata"] for band in flags)
        all_valid = all([flag.name for flag in band] == ["all_valid"] for band in flags)
        self._masked = not (all_valid or (all_nodata and self._missing is not None))
        if all_valid:
            self._missing = None
        nodata = correction.nodata if correction.nodata is not None else self._missing
        if (
            nodata is not None
            and as_type(np.array(nodata), dtype) != nodata
            and not np.isnan(nodata)
        ):
            raise InputError(
                f"--nodata {nodata:g}: {path} has values of {dtype}; give one of these"
            )
        if nodata is not None and np.isnan(nodata) and dtype.kind != "f":
            raise InputError(
                f"--nodata {nodata:g}: {path} has values of {dtype}; give one of these"
            )
        self.bands = MapBands(
            raster.count,
            str(dtype),
            nodata,
            tuple(name or "" for name in raster.descriptions),
            (raster.scales, raster.offsets),
            raster.colorinterp,
        )
        self._keeps_apart = nodata is not None and dtype.kind != "f"

    def values_at(self, image: PushbroomImage | RpcImage, places: Places) -> np.ndarray | None:
        """The values [bands, rows, columns] of all bands at the positions of a block; None if
        no data."""
        line, pixel = map(np.asarray, places)
        dtype = np.dtype(self.bands.dtype)
        block = np.full((*line.shape, self.bands.count), self.bands.nodata_value, dtype)
        # 2²² values of all bands are at most 32 MB in memory for each of the two workers
        max_pixels, reach = 2**22 / self.bands.count, REACH[self._kind]
        has_values = False
        for part, window in _parts(line, pixel, image, max_pixels, reach):
            pixels = self._read_window(window)
            (first_line, _), (first_pixel, _) = window
            values, part_has_values = _resample(
                self._kind,
                str(dtype),
                self._keeps_apart,
                pixels,
                (np.nan if self._missing is None or self._masked else self._missing),
                self.bands.nodata_value,
                (line[part] - first_line, pixel[part] - first_pixel),
            )
            block[part] = values
            has_values |= bool(part_has_values)
        return np.moveaxis(block, -1, 0) if has_values else None

    def _read_window(self, window: Window) -> np.ndarray:
        """The pixels [rows, columns, bands] of a window, NaN where they are masked.

        Widened to a multiple of 128, or of an eighth of the size: the compiled program is one for
        every shape, and there are only a few shapes then."""
        # Only reading is locked, the other worker computes meanwhile.
        with self._reading:
            if self._masked:
                values = read_values(self._path, self._raster, None, window)
            else:
                values = read_plain(self._path, self._raster, window)
        pad = [(0, -n % max(128, 2 ** (n.bit_length() - 3))) for n in values.shape[1:]]
        return np.pad(np.moveaxis(values, 0, -1), [*pad, (0, 0)], mode="edge")


@partial(compile_once, static=(0, 1, 2))
def _resample(
    kind: Resampling,
    dtype: str,
    keeps_apart: bool,
    pixels: Num[AnyArray, "rows columns bands"],
    source_nodata: Scalar,
    nodata: Scalar,
    positions: tuple[Float[AnyArray, "*shape"], Float[AnyArray, "*shape"]],
) -> tuple[Num[Array, "*shape bands"], Bool[Array, ""]]:
    """The stored values at positions, and whether there are any.

    **Arguments:** `keeps_apart`: a value that is by chance that of no data, `nodata`, is changed
    by one; `source_nodata`: the value of no data of the pixels, NaN for none.
    """
    working = working_type(pixels.dtype)
    is_nodata = pixels == jnp.asarray(source_nodata).astype(pixels.dtype)
    is_nodata &= ~jnp.isnan(source_nodata)
    has_gaps = jnp.any(is_nodata)
    # A copy in floating point only where it is needed.
    values = jax.lax.cond(
        has_gaps,
        lambda: resample_pixels(
            jnp.where(is_nodata, jnp.nan, pixels.astype(working)), *positions, kind
        ),
        lambda: resample_pixels(pixels, *positions, kind),
    )
    has_value = ~jnp.isnan(values)
    if np.dtype(dtype).kind == "f":
        return jnp.where(has_value, values, nodata).astype(dtype), jnp.any(has_value)
    limits = np.iinfo(dtype)
    rounded = jnp.clip(jnp.round(values), float(limits.min), float(limits.max))
    if keeps_apart:
        neighbour_value = jnp.where(nodata < limits.max, nodata + 1, nodata - 1)
        rounded = jnp.where(rounded == nodata, neighbour_value, rounded)
    return jnp.where(has_value, rounded, nodata).astype(dtype), jnp.any(has_value)


def _parts(
    line: Float[np.ndarray, "rows columns"],
    pixel: Float[np.ndarray, "rows columns"],
    image: PushbroomImage | RpcImage,
    max_pixels: float,
    reach: int,
    part: Part = (slice(0, BLOCK_SIZE), slice(0, BLOCK_SIZE)),
) -> Iterator[tuple[Part, Window]]:
    """Quarters of a block, quartered again until each covers at most `max_pixels` of the image.

    Each as slices of the block, with the required rows and columns of the image. Parts outside the
    image are left out.
    """
    positions = line[part], pixel[part]
    if not np.isfinite(positions[0]).any():
        return
    # One pixel more than the kernel reaches, for rounding.
    margin = reach + 1
    lines, pixels = (
        (max(int(np.nanmin(v)) - margin, 0), min(int(np.nanmax(v)) + margin + 1, size))
        for v, size in zip(positions, (image.lines, image.pixels))
    )
    window = lines, pixels
    side = part[0].stop - part[0].start
    # A single place cannot be halved, whatever it needs.
    if side == 1 or (lines[1] - lines[0]) * (pixels[1] - pixels[0]) <= max_pixels:
        yield part, window
        return
    halves = [
        [slice(s.start, s.start + side // 2), slice(s.start + side // 2, s.stop)] for s in part
    ]
    for rows, columns in itertools.product(*halves):
        yield from _parts(line, pixel, image, max_pixels, reach, (rows, columns))
