"""A map as a GeoTIFF, made and written block by block, two at a time, under a temporary name."""

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np

from jaxbundle.io.rasters.maps import MapGrid, MapSystem
from jaxbundle.io.rasters.reading import as_type, rasterio
from jaxbundle.io.rasters.writing import write_raster
from jaxbundle.pushbroom.rectification import BLOCK_SIZE, NODE_STEP, MapNodes
from jaxbundle.pushbroom.surfaces import GroundSurface
from jaxbundle.types import Progress


def write_map(
    target: str | Path,
    system: MapSystem,
    grid: MapGrid,
    surface: GroundSurface,
    count: int,
    dtype: str,
    block: Callable[[MapNodes], np.ndarray | None],
    progress: Progress | None = None,
    names: Sequence[str] = (),
    scales: tuple[Sequence[float], Sequence[float]] | None = None,
) -> None:
    """Write the map of `grid`, `count` bands of the type `dtype`.

    `block` computes the values [count, `BLOCK_SIZE`, `BLOCK_SIZE`] of a block from its nodes, NaN
    if missing; None if all are missing. `names` describe the bands, `scales` are the scales and
    offsets of their stored values.

    **Raises:** `InputError` if the file cannot be written.
    """
    floating = np.issubdtype(dtype, np.floating)
    steps = np.arange(0, BLOCK_SIZE + NODE_STEP, NODE_STEP)

    def write_block(corner: tuple[int, int]) -> None:
        row, column = corner
        values = block(system.nodes(surface, *grid.centres(row + steps, column + steps)))
        if values is None or not np.isfinite(values).any():
            return
        rows, columns = min(BLOCK_SIZE, grid.rows - row), min(BLOCK_SIZE, grid.columns - column)
        values = as_type(values[:, :rows, :columns], dtype)
        map_.write(values, row, column)

    corners = [
        (r, c) for r in range(0, grid.rows, BLOCK_SIZE) for c in range(0, grid.columns, BLOCK_SIZE)
    ]
    with write_raster(
        target,
        grid.columns,
        grid.rows,
        count,
        dtype,
        crs=system.text,
        nodata=np.nan if floating else 0,
        tiled=True,
        blockxsize=BLOCK_SIZE,
        blockysize=BLOCK_SIZE,
        transform=rasterio().transform.Affine(grid.size, 0, grid.x, 0, -grid.size, grid.y),
    ) as map_:
        if names:
            map_.describe(names)
        if scales is not None:
            map_.scale(*scales)
        # Two workers: while one computes, the other reads or writes.
        with ThreadPoolExecutor(2) as workers:
            for done, _ in enumerate(workers.map(write_block, corners), 1):
                if progress:
                    progress("blocks", done, len(corners))
