"""Heights of the geoid above the ellipsoid, added to terrain models of orthometric heights.

    h = H + N(λ, φ),      N bilinear in a grid

The grid is a raster with georeference (GeoTIFF, GTX), or a grid of PROJ by its name, such as
`us_nga_egm96_15.tif`, which `projsync` fetches (through pyproj).
"""

from collections.abc import Callable
from pathlib import Path

import numpy as np
from jaxtyping import Float

from jaxbundle.errors import InputError
from jaxbundle.geometry.ellipsoid import WGS84
from jaxbundle.io.rasters.extent import Extent
from jaxbundle.io.rasters.terrain_models import read_terrain
from jaxbundle.pushbroom.terrain import Terrain, make_terrain


def add_geoid(terrain: Terrain, geoid: Path) -> Terrain:
    """Terrain with heights above the ellipsoid, from heights above the geoid.

    **Raises:** `InputError` if the geoid cannot be read, or has no height at a point of the
    terrain model.
    """
    if terrain.earth is None:
        raise InputError("--geoid: a local frame has no geoid; omit it")
    heights = np.asarray(terrain.heights)
    longitude, latitude = (
        np.degrees(terrain.origin[k] + terrain.step[k] * np.arange(heights.shape[1 - k]))
        for k in (0, 1)
    )
    N = undulations(geoid, longitude, latitude)
    is_missing = np.isnan(N)
    is_missing &= np.isfinite(heights)
    if is_missing.any():
        row, column = np.argwhere(is_missing)[0]
        raise InputError(
            f"{geoid}: no height of the geoid at longitude {longitude[column]:.6g}°, latitude "
            f"{latitude[row]:.6g}°; give a geoid that covers the terrain model"
        )
    N += heights
    return make_terrain(N, terrain.origin, terrain.step, terrain.earth)


def undulations(
    geoid: Path, longitude: Float[np.ndarray, " columns"], latitude: Float[np.ndarray, " rows"]
) -> Float[np.ndarray, "rows columns"]:
    """N in metres at longitudes × latitudes in degrees; NaN outside the grid."""
    return undulations_at(geoid, longitude[None], latitude[:, None])


def undulations_at(
    geoid: Path, longitude: Float[np.ndarray, "*#shape"], latitude: Float[np.ndarray, "*#shape"]
) -> Float[np.ndarray, "*shape"]:
    """N in metres at points, degrees; NaN outside the grid."""
    geoid = Path(geoid)
    if not geoid.exists():
        return _evaluate_in_portions(_grid_of_proj(geoid), longitude, latitude)
    extent = Extent(longitude.min(), latitude.min(), longitude.max(), latitude.max())
    grid = read_terrain(geoid, WGS84, extent)
    heights, (x0, y0), (dx, dy) = np.asarray(grid.heights), *np.degrees([grid.origin, grid.step])
    middle = x0 + dx * (heights.shape[1] - 1) / 2
    longitude = longitude - 360 * np.round((longitude - middle) / 360)
    function = lambda x, y: _bilinear(heights, (y - y0) / dy, (x - x0) / dx)
    return _evaluate_in_portions(function, longitude, latitude)


def _evaluate_in_portions(
    function: Callable[[np.ndarray, np.ndarray], np.ndarray],
    longitude: Float[np.ndarray, "*#shape"],
    latitude: Float[np.ndarray, "*#shape"],
    portion: int = 1 << 18,
) -> Float[np.ndarray, "*shape"]:
    """A function of points, about `portion` of them at a time: interpolation has a dozen arrays of
    their number, for 2¹⁸ points 25 MB."""
    shape = np.broadcast_shapes(longitude.shape, latitude.shape)
    values = np.empty(shape)
    if values.size <= portion:
        values[...] = function(longitude, latitude)
        return values
    rows = max(1, portion // (values.size // shape[0]))
    for begin in range(0, shape[0], rows):
        part = slice(begin, begin + rows)
        # An axis of one stands for all rows.
        x, y = (
            a[part] if a.ndim == len(shape) and len(a) > 1 else a for a in (longitude, latitude)
        )
        values[part] = function(x, y)
    return values


def _bilinear(
    values: Float[np.ndarray, "grid_rows grid_columns"],
    row: Float[np.ndarray, "*#shape"],
    column: Float[np.ndarray, "*#shape"],
) -> Float[np.ndarray, "*shape"]:
    """Values at rows and columns; NaN outside, or if a NaN has a weight."""
    edge = 1e-6  # cells: by rounding of degrees a point of the border may lie beyond it
    clip_to_grid = lambda position, n: np.where(
        (position >= -edge) & (position <= n - 1 + edge), np.clip(position, 0, n - 1), np.nan
    )
    (i, u), (k, v) = (
        (np.clip(np.nan_to_num(np.floor(p)).astype(int), 0, n - 2), p)
        for p, n in zip(map(clip_to_grid, (row, column), values.shape), values.shape)
    )
    u, v = u - i, v - k
    # A NaN beside a point that lies on a line of the grid has the weight 0, but 0·NaN is NaN.
    interpolate = lambda w, low, high: (
        np.where(w == 0, 0, w * high) + np.where(w == 1, 0, (1 - w) * low)
    )
    in_row = lambda i: interpolate(v, values[i, k], values[i, k + 1])
    return interpolate(u, in_row(i), in_row(i + 1))


def _grid_of_proj(name: Path) -> Callable[[np.ndarray, np.ndarray], np.ndarray]:
    """N of a grid of PROJ as a function of longitude and latitude."""
    try:
        import pyproj.datadir
        import pyproj.exceptions
    except ImportError:
        raise InputError("PROJ's grids need pyproj: pip install 'jaxbundle[geo]'") from None
    try:
        transformer = pyproj.Transformer.from_pipeline(
            "+proj=pipeline +step +proj=unitconvert +xy_in=deg +xy_out=rad +step +proj=vgridshift "
            f"+grids={name} +multiplier=1 +step +proj=unitconvert +xy_in=rad +xy_out=deg"
        )
    except pyproj.exceptions.ProjError:
        # Public in the documentation, though not in the stub.
        folder = pyproj.datadir.get_user_data_dir()  # pyright: ignore[reportPrivateImportUsage]
        raise InputError(
            f"--geoid {name}: there is no such file, and PROJ has no grid of this name (its folder "
            f"is {folder}); give a raster of the geoid, or fetch the "
            "grid with projsync"
        ) from None

    def function(longitude: np.ndarray, latitude: np.ndarray) -> np.ndarray:
        x, y = (np.array(v) for v in np.broadcast_arrays(longitude, latitude))
        N = transformer.transform(x, y, np.zeros_like(x))[2]
        return np.where(np.isfinite(N), N, np.nan)

    return function
