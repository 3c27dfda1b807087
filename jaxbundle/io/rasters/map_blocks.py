"""A map as a GeoTIFF, made block by block and written in their order, under a temporary name."""

import dataclasses
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np

from jaxbundle.choices import Compression
from jaxbundle.io.rasters.checkpoints import Checkpoint
from jaxbundle.io.rasters.maps import MapGrid, MapSystem
from jaxbundle.io.rasters.writing import add_overviews, make_cog, write_raster
from jaxbundle.pushbroom.rectification import BLOCK_SIZE, NODE_STEP, MapNodes
from jaxbundle.pushbroom.surfaces import GroundSurface
from jaxbundle.system.rasters import as_type, rasterio
from jaxbundle.types import Progress

# While two blocks are computed, as many wait for their turn to be written: a slow one does not stop
# the other worker, and no more than this is in memory.
WORKERS, AHEAD = 2, 4


@dataclasses.dataclass(frozen=True)
class MapFormat:
    """How a map is stored: `overviews` inside the file; `cog`: as a Cloud Optimized GeoTIFF, with
    overviews; `nearest`: overviews of chosen pixels instead of means."""

    compress: Compression = "none"
    overviews: bool = False
    cog: bool = False
    nearest: bool = False


PLAIN = MapFormat()


@dataclasses.dataclass(frozen=True)
class MapBands:
    """The bands of a map: their number, type, value of no data (None: NaN, or 0 of whole numbers),
    names, scales and offsets of their stored values, what their colours mean (rasterio's
    `ColorInterp`)."""

    count: int
    dtype: str
    nodata: float | None = None
    names: Sequence[str] = ()
    scales: tuple[Sequence[float], Sequence[float]] | None = None
    colors: Sequence[Any] = ()

    @property
    def photometric(self) -> dict[str, str]:
        """GDAL's options: without them a fourth band of 8 bits would be a mask of the others."""
        rgb = [color.name for color in self.colors[:3]] == ["red", "green", "blue"]
        alpha = "yes" if any(color.name == "alpha" for color in self.colors) else "no"
        return {"photometric": "rgb" if rgb else "minisblack", "alpha": alpha}

    @property
    def nodata_value(self) -> float:
        """The value of no data."""
        if self.nodata is not None:
            return self.nodata
        return np.nan if np.issubdtype(self.dtype, np.floating) else 0


def write_map(
    target: str | Path,
    system: MapSystem,
    grid: MapGrid,
    surface: GroundSurface,
    bands: MapBands,
    block: Callable[[MapNodes], np.ndarray | None],
    progress: Progress | None = None,
    format: MapFormat = PLAIN,
    checkpoint: Checkpoint | None = None,
) -> None:
    """Write the map of `grid`.

    `block` computes the values [bands, `BLOCK_SIZE`, `BLOCK_SIZE`] of a block from its nodes: of
    the type of the map, or floating with NaN for no data; None if there are none.

    Blocks are written in their order: the same map is the same file. Those in a `checkpoint` are
    not computed.

    **Raises:** `InputError` if the file cannot be written.
    """
    corners = [
        (r, c) for r in range(0, grid.rows, BLOCK_SIZE) for c in range(0, grid.columns, BLOCK_SIZE)
    ]
    steps = np.arange(0, BLOCK_SIZE + NODE_STEP, NODE_STEP)

    def compute(corner: tuple[int, int]) -> np.ndarray | None:
        row, column = corner
        values = block(system.nodes(surface, *grid.centres(row + steps, column + steps)))
        if values is None:
            return None
        values = values[:, : grid.rows - row, : grid.columns - column]
        if values.dtype != bands.dtype:
            if not np.isfinite(values).any():
                return None
            values = as_type(values, bands.dtype, bands.nodata_value)
        return values

    finish = None
    if format.overviews or format.cog:
        finish = lambda path: _finish(path, grid, format)
    with write_raster(
        target,
        grid.columns,
        grid.rows,
        bands.count,
        bands.dtype,
        finish,
        crs=system.text,
        nodata=bands.nodata_value,
        tiled=True,
        blockxsize=BLOCK_SIZE,
        blockysize=BLOCK_SIZE,
        interleave="pixel",
        transform=rasterio().transform.Affine(grid.size, 0, grid.x, 0, -grid.size, grid.y),
        **bands.photometric,
        # A COG is compressed when it is made from the file.
        **({} if format.cog else _compression(format.compress, bands.dtype)),
    ) as map_:
        if any(bands.names):
            map_.describe(bands.names)
        if bands.scales is not None:
            map_.scale(*bands.scales)
        size = lambda corner: (
            bands.count,
            min(BLOCK_SIZE, grid.rows - corner[0]),
            min(BLOCK_SIZE, grid.columns - corner[1]),
        )
        stored_block = lambda k, corner: (
            checkpoint and checkpoint.take(k, size(corner), bands.dtype)
        )
        for k, (corner, values, is_new) in enumerate(
            _ordered_blocks(corners, stored_block, compute)
        ):
            if is_new and checkpoint is not None:
                checkpoint.add(k, values)
            if values is not None and values.size:
                map_.write(values, *corner)
            if progress:
                progress("blocks", k + 1, len(corners))


def _ordered_blocks(
    corners: Sequence[tuple[int, int]],
    stored_block: Callable[[int, tuple[int, int]], np.ndarray | None],
    compute: Callable[[tuple[int, int]], np.ndarray | None],
) -> Iterator[tuple[tuple[int, int], np.ndarray | None, bool]]:
    """The values of blocks in their order, kept ones or else computed by workers, and whether they
    were computed."""
    number = 0
    while number < len(corners) and (values := stored_block(number, corners[number])) is not None:
        yield corners[number], values, False
        number += 1
    remaining_corners = iter(corners[number:])
    waiting: deque[tuple[tuple[int, int], Future]] = deque()
    with ThreadPoolExecutor(WORKERS) as workers:
        try:
            while True:
                while (
                    len(waiting) < WORKERS + AHEAD
                    and (corner := next(remaining_corners, None)) is not None
                ):
                    waiting.append((corner, workers.submit(compute, corner)))
                if not waiting:
                    return
                corner, future = waiting.popleft()
                yield corner, future.result(), True
        finally:
            workers.shutdown(cancel_futures=True)


def _compression(compress: Compression, dtype: str) -> dict[str, Any]:
    """GDAL's options: differences of neighbours are compressed, of floating point numbers by
    bytes."""
    if compress == "none":
        return {}
    return {"compress": compress, "predictor": 3 if np.issubdtype(dtype, np.floating) else 2}


def _finish(path: Path, grid: MapGrid, format: MapFormat) -> None:
    add_overviews(path, (grid.rows, grid.columns), format.nearest, BLOCK_SIZE)
    if format.cog:
        make_cog(path, format.compress, BLOCK_SIZE, format.nearest)
