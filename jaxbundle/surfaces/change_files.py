"""Maps of change as GeoTIFF."""

from pathlib import Path

import numpy as np

from jaxbundle.io.rasters.vertical import horizontal_system
from jaxbundle.io.rasters.writing import write_raster
from jaxbundle.surfaces.change import SurfaceChange
from jaxbundle.surfaces.dsm import NO_DATA

# Of `significant.tif`.
FALLEN, UNCHANGED, RISEN, UNKNOWN = 1, 2, 3, 0


def write_change(change: SurfaceChange, difference: str | Path, significant: str | Path) -> None:
    """Write the difference, its σ and w as three bands, no-data `NO_DATA`; and the significant
    cells: 1 fallen, 2 unchanged, 3 risen, no-data 0."""
    from rasterio.transform import Affine

    profile = {
        "transform": Affine(change.size, 0, change.x, 0, -change.size, change.y),
        "crs": horizontal_system(change.system),
        "compress": "deflate",
    }
    rows, columns = change.difference.shape
    # 512 rows of 10 000 cells are 60 MB in three bands of 4 bytes
    parts = [slice(k, min(k + 512, rows)) for k in range(0, rows, 512)]
    with write_raster(difference, columns, rows, 3, "float32", nodata=NO_DATA, **profile) as raster:
        for part in parts:
            d, sigma = change.difference[part], change.sigma[part]
            bands = np.nan_to_num(np.stack([d, sigma, d / sigma]), nan=NO_DATA)
            raster.write(bands.astype(np.float32), part.start)
        raster.describe(["difference", "sigma of difference", "difference over sigma"])
    with write_raster(significant, columns, rows, 1, "uint8", nodata=UNKNOWN, **profile) as raster:
        for part in parts:
            is_known = np.isfinite(change.difference[part])
            values = np.where(is_known, UNCHANGED + change.sign[part], UNKNOWN).astype(np.uint8)
            raster.write(values[None], part.start)
        raster.describe(["1 fallen, 2 unchanged, 3 risen"])
