"""A raster corrected to a map: GeoTIFF, block by block, a few blocks in memory at a time."""

import itertools
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float

from jaxbundle.choices import Resampling
from jaxbundle.errors import InputError
from jaxbundle.io.rasters.map_blocks import write_map
from jaxbundle.io.rasters.maps import MapGrid, MapSystem, contiguous, grid_around
from jaxbundle.io.rasters.reading import Window, check_raw, open_raster, read_values
from jaxbundle.pushbroom.ground_to_image import Search
from jaxbundle.pushbroom.image import PushbroomImage
from jaxbundle.pushbroom.image_to_ground import locate_lines
from jaxbundle.pushbroom.rectification import BLOCK_SIZE, MapNodes, block_places
from jaxbundle.pushbroom.resampling import resample
from jaxbundle.pushbroom.rpc.image import RpcImage, locate_rpc_lines
from jaxbundle.pushbroom.surfaces import GroundSurface
from jaxbundle.pushbroom.terrain import Terrain
from jaxbundle.system.programs import compile_once
from jaxbundle.types import AnyArray, Progress

if TYPE_CHECKING:
    from rasterio.io import DatasetReader

# Rows and columns of a block.
Part = tuple[slice, slice]

_resample = compile_once(resample, 3)
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
) -> MapGrid:
    """The pixels of a map of the whole image, by default with its size on the ground.

    **Arguments:** `model` names the file of a terrain in messages; `border`: points along each
    border of the image that bound the map, enough for the bends of a track and of a terrain: what
    they miss is cut off, except for the margin of a pixel; `max_pixels` of the map for one of the
    image: more indicate a wrong spacing, such as metres where the map is in degrees.

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
    x, y = system.from_ground(X)
    if not np.isfinite(x).any():
        raise InputError(f"coordinate system {system.crs}: it is not defined where the image is")
    x = contiguous(system, x)
    if size is None:
        rows = np.hypot(np.diff(x, axis=0), np.diff(y, axis=0)) / np.diff(inner)[:, None]
        columns = np.hypot(np.diff(x, axis=1), np.diff(y, axis=1)) / np.diff(pixels)
        # two digits: a round size that a reader can repeat
        size = float(f"{min(np.nanmedian(rows), np.nanmedian(columns)):.2g}")
    grid = grid_around(x, y, size, max_pixels * image.lines * image.pixels)
    # a line beyond the outermost centres, outside the border
    return MapGrid(grid.x - size, grid.y + size, size, grid.columns + 2, grid.rows + 2)


def write_corrected(
    source: str | Path,
    target: str | Path,
    image: PushbroomImage | RpcImage,
    search: Search | None,
    surface: GroundSurface,
    system: MapSystem,
    grid: MapGrid,
    resampling: Resampling = "bilinear",
    progress: Progress | None = None,
    occlusion: bool = False,
) -> None:
    """Write the raster `source`, taken by the image, as the map `target`.

    All bands, in the type of the source, with its scales and offsets; NaN or 0 (declared as no
    data) outside the image, where the source has no data, and, with `occlusion`, also for hidden
    terrain.

    **Raises:** `InputError` if the raster does not have the size of the image, or cannot be read.
    """
    with open_raster(source) as bands:
        if not isinstance(image, RpcImage):
            check_raw(source, bands)
        if (bands.height, bands.width) != (image.lines, image.pixels):
            raise InputError(
                f"{source}: {bands.height} lines of {bands.width} pixels; the "
                f"{'image of the RPC' if isinstance(image, RpcImage) else 'scanner file'} has "
                f"{image.lines} of {image.pixels}"
            )
        reading = threading.Lock()  # GDAL: one thread at a time in a data set

        def block(nodes: MapNodes) -> Float[np.ndarray, "bands rows columns"] | None:
            places = block_places(image, search, surface, nodes, occlusion)
            if places is None:
                return None
            return _values(source, bands, reading, image, places, resampling)

        write_map(
            target,
            system,
            grid,
            surface,
            bands.count,
            bands.dtypes[0],
            block,
            progress,
            scales=(bands.scales, bands.offsets),
        )


def _values(
    source: str | Path,
    bands: "DatasetReader",
    reading: threading.Lock,
    image: PushbroomImage | RpcImage,
    places: tuple[Float[AnyArray, "rows columns"], Float[AnyArray, "rows columns"]],
    resampling: Resampling,
) -> Float[np.ndarray, "bands rows columns"]:
    """All bands at the positions of a block."""
    line, pixel = (np.asarray(p) for p in places)
    values = np.full((bands.count, *line.shape), np.nan)
    # 2²² values of all bands are 32 MB of doubles in memory for each of the two workers.
    for part, window in _parts(line, pixel, image, 2**22 / bands.count):
        # only reading is locked, the other worker computes meanwhile
        with reading:
            seen = read_values(source, bands, None, window)
        # Widened to a multiple of 128, or of an eighth of the size: the compiled program is one for
        # every shape, and there are only a few shapes then.
        pad = [(0, -n % max(128, 2 ** (n.bit_length() - 3))) for n in seen.shape[1:]]
        seen = np.pad(seen, [(0, 0), *pad], mode="edge")
        (top, _), (left, _) = window
        values[:, *part] = _resample(seen, line[part] - top, pixel[part] - left, resampling)
    return values


def _parts(
    line: Float[np.ndarray, "rows columns"],
    pixel: Float[np.ndarray, "rows columns"],
    image: PushbroomImage | RpcImage,
    most: float,
    part: Part = (slice(0, BLOCK_SIZE), slice(0, BLOCK_SIZE)),
) -> Iterator[tuple[Part, Window]]:
    """Quarters of a block, quartered again until each covers at most `most` pixels of the image.

    Each as slices of the block, with the required rows and columns of the image. Parts outside the
    image are left out.
    """
    seen = line[part], pixel[part]
    if not np.isfinite(seen[0]).any():
        return
    # the cubic kernel, the widest, reaches 2 pixels beyond a position; 3 leave one for rounding
    margin = 3
    lines, pixels = (
        (max(int(np.nanmin(v)) - margin, 0), min(int(np.nanmax(v)) + margin + 1, size))
        for v, size in zip(seen, (image.lines, image.pixels))
    )
    window = lines, pixels
    side = part[0].stop - part[0].start
    # a single place cannot be halved, whatever it needs
    if side == 1 or (lines[1] - lines[0]) * (pixels[1] - pixels[0]) <= most:
        yield part, window
        return
    halves = [
        [slice(s.start, s.start + side // 2), slice(s.start + side // 2, s.stop)] for s in part
    ]
    for rows, columns in itertools.product(*halves):
        yield from _parts(line, pixel, image, most, (rows, columns))
