"""A raster corrected to a map: GeoTIFF, block by block, a few blocks in memory at a time."""

import itertools
import threading
from pathlib import Path

import numpy as np

from jaxbundle.choices import Resampling
from jaxbundle.errors import InputError
from jaxbundle.io.rasters.map_blocks import write_map
from jaxbundle.io.rasters.maps import MapGrid, MapSystem, contiguous, grid_around
from jaxbundle.io.rasters.reading import open_plain, rasterio, unreadable
from jaxbundle.pushbroom.image import PushbroomImage
from jaxbundle.pushbroom.locate import locate_lines
from jaxbundle.pushbroom.project import Search
from jaxbundle.pushbroom.rectification import BLOCK, block_places
from jaxbundle.pushbroom.resample import resample
from jaxbundle.pushbroom.surfaces import Surface
from jaxbundle.pushbroom.terrain import Terrain
from jaxbundle.system.programs import compile_once
from jaxbundle.types import Progress

MARGIN = 3
"""Pixels that resampling may require beyond the outermost position."""
WINDOW_STEP = 128
"""Windows of the image are widened to a multiple of this, or an eighth: few shapes to compile."""
WINDOW = 2**22
"""Image values, of all bands, in memory for a part of a block."""
BORDER = 33
"""Points along each border of the image that bound the map."""
MOST_PIXELS = 10_000
"""Pixels of a map relative to those of the image: more indicate a wrong spacing."""

_resample = compile_once(resample, 3)
_locate = compile_once(locate_lines, ())


def map_of(
    image: PushbroomImage,
    surface: Surface,
    system: MapSystem,
    size: float | None,
    model: str | Path | None = None,
) -> MapGrid:
    """The pixels of a map of the whole image, by default with its size on the ground.

    `model` names the file of a terrain in messages.

    **Raises:** `InputError` if the image shows nothing of the surface, its map does not hold
    together, or is too large.
    """
    lines = np.linspace(-0.5, image.lines - 0.5, BORDER)
    pixels = np.linspace(-0.5, image.pixels - 0.5, BORDER)
    inner = np.clip(lines, 0, image.lines - 1)  # the tables may end at the outer lines' centres
    X = np.asarray(_locate(image, surface, inner, pixels))
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
        size = float(f"{min(np.nanmedian(rows), np.nanmedian(columns)):.2g}")
    grid = grid_around(x, y, size, MOST_PIXELS * image.lines * image.pixels)
    # a line beyond the outermost centres, outside the border
    return MapGrid(grid.x - size, grid.y + size, size, grid.columns + 2, grid.rows + 2)


def write_corrected(
    source: str | Path,
    target: str | Path,
    image: PushbroomImage,
    search: Search,
    surface: Surface,
    system: MapSystem,
    grid: MapGrid,
    resampling: Resampling = "bilinear",
    progress: Progress | None = None,
    occlusion: bool = False,
) -> None:
    """Write the raster `source`, taken by the image, as the map `target`.

    All bands, in the type of the source; NaN or 0 (declared as no data) outside the image and,
    with `occlusion`, also for hidden terrain.

    **Raises:** `InputError` if the raster does not have the size of the image, or cannot be read.
    """
    package = rasterio()
    try:
        with open_plain(source) as bands:
            if (bands.height, bands.width) != (image.lines, image.pixels):
                raise InputError(
                    f"{source}: {bands.height} lines of {bands.width} pixels; the scanner file has "
                    f"{image.lines} of {image.pixels}"
                )
            reading = threading.Lock()

            def block(nodes):
                places = block_places(image, search, surface, nodes, occlusion)
                if places is None:
                    return None
                try:
                    return _values(bands, reading, image, places, resampling)
                except package.errors.RasterioError as error:
                    raise unreadable(source, error) from None

            write_map(target, system, grid, surface, bands.count, bands.dtypes[0], block, progress)
    except package.errors.RasterioError as error:
        raise unreadable(source, error) from None


def _values(bands, reading, image, places, resampling):
    """All bands at the positions of a block."""
    line, pixel = (np.asarray(p) for p in places)
    values = np.full((bands.count, *line.shape), np.nan)
    for part, window in _parts(line, pixel, image, WINDOW / bands.count):
        with reading:
            seen = bands.read(window=window)
        pad = [(0, -n % max(WINDOW_STEP, 2 ** (n.bit_length() - 3))) for n in seen.shape[1:]]
        seen = np.pad(seen.astype(float), [(0, 0), *pad], mode="edge")
        (top, _), (left, _) = window
        values[:, *part] = _resample(seen, line[part] - top, pixel[part] - left, resampling)
    return values


def _parts(line, pixel, image, most, part=(slice(0, BLOCK), slice(0, BLOCK))):
    """Quarters of a block, quartered again until each covers few enough pixels of the image.

    Each as slices of the block, with the required rows and columns of the image. Parts outside the
    image are left out.
    """
    seen = line[part], pixel[part]
    if not np.isfinite(seen[0]).any():
        return
    window = tuple(
        (max(int(np.nanmin(v)) - MARGIN, 0), min(int(np.nanmax(v)) + MARGIN + 1, size))
        for v, size in zip(seen, (image.lines, image.pixels))
    )
    side = part[0].stop - part[0].start
    if side == 1 or (window[0][1] - window[0][0]) * (window[1][1] - window[1][0]) <= most:
        yield part, window
        return
    halves = [
        [slice(s.start, s.start + side // 2), slice(s.start + side // 2, s.stop)] for s in part
    ]
    for quarter in itertools.product(*halves):
        yield from _parts(line, pixel, image, most, quarter)
