"""Maps of change as GeoTIFF."""

from pathlib import Path

import numpy as np

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
        "crs": change.system,
        "compress": "deflate",
    }
    rows, columns = change.difference.shape
    bands = np.stack([change.difference, change.sigma, change.significance])
    with write_raster(difference, columns, rows, 3, "float32", nodata=NO_DATA, **profile) as raster:
        raster.write(np.nan_to_num(bands, nan=NO_DATA).astype(np.float32))
        raster.describe(["difference", "sigma of difference", "difference over sigma"])
    values = np.where(change.known, UNCHANGED + change.sign, UNKNOWN).astype(np.uint8)
    with write_raster(significant, columns, rows, 1, "uint8", nodata=UNKNOWN, **profile) as raster:
        raster.write(values[None])
        raster.describe(["1 fallen, 2 unchanged, 3 risen"])
