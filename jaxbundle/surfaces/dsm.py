"""A digital surface model of a cloud: heights on a grid with the σ of every cell.

A cell has the height of the surface at its centre: the weighted mean of the heights of its points,
p = 1/σ_Z², without those that differ from their median by more than three times its spread, moved
along the slope s (`cell_slopes.py`) from their centroid, which is d beside the centre: z = z̄ − s·d,
and the variance of s adds dᵀ·C·d to that of the mean. Errors of neighbours are highly correlated,
since the windows of their matching overlap, those of several base images as much as those of one,
since their pairs are of the same images. Points of a base image within a × b pixels count as
m = m₁(a/w)·m₁(b/w) independent ones, w the side of the windows: those whose mean has the variance
of that over a × b pixels with the correlation (1 − |Δu|/w)·(1 − |Δv|/w), the common part of two
windows; at most as the n that they are, and of several base images the most. With the scatter of
the points about their slope, σ² = max(n/m, χ²/(n − 1))/Σp.
Small gaps are filled with the mean of the heights around, weighted by the inverse squares of their
distances, with σ from the cells around and the distance to them; beside a wall from the lower
surface, since hidden parts are low (Hirschmüller 2008).

The errors of the orientations are common to the points of a cell, and no mean reduces them: weights
are by the σ without them, and their mean variance is added to that of the cell.
"""

import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy import ndimage

from jaxbundle.arguments import positive
from jaxbundle.display import data_set, print_in_one_screen
from jaxbundle.errors import InputError
from jaxbundle.io.rasters.vertical import horizontal_system
from jaxbundle.io.rasters.writing import write_raster
from jaxbundle.leastsquares.quality.distributions import NORMAL_SIGMA_BY_MAD
from jaxbundle.surfaces.cell_slopes import CellMeans, cell_slopes
from jaxbundle.surfaces.cloud import Cloud

if TYPE_CHECKING:
    import xarray

# The description of the band of the σ without the errors of the orientations.
OWN_SIGMA = "sigma of height without orientation"
# The value of cells without height in files: the one most programs for height models expect.
NO_DATA = -9999.0


@dataclasses.dataclass(frozen=True)
class DsmSettings:
    """How the cells of a model are averaged and filled."""

    max_deviation: float = 3.0
    """Heights farther from the median of their cell are left out; robust σ. The usual limit: 0.3 %
    of normal errors are lost."""
    min_spread: float = 0.3
    """Least σ for `max_deviation`, in cell sizes: on a slope of 45° the heights of a cell have a
    standard deviation of 1/√12 of its size, and are all good."""
    slope: float = 0.3
    """σ of the slope of the surface where it is not known, 17°: in a gap, whose cells have this in
    cell sizes for each cell of distance, and before it is measured. To be larger for steep terrain;
    no measurement stands behind it."""
    step: float = 4.28
    """Ratio of variance factors of two planes above which the worse one has a step: the 95 %
    quantile of F(6, 6), of nine cells each less three unknowns. Larger: slopes lean over low steps;
    smaller: those of one side are taken on smooth ground, where it is curved."""
    wall: float = 1.0
    """Standard deviation of the heights around a gap, or of 3 × 3 cells, in cell sizes, above which
    they are of two surfaces: that of a wall is half its height, of 3 × 3 cells on a slope 0.8 of
    it. Larger: gaps beside higher walls are filled with means, and cells there may lean; smaller:
    steep slopes are filled from below, and count as not known."""
    window: float = 5.0
    """Side of the windows of matching, pixels, `SurfaceSettings.window`: that of dense matching by
    default, since files of clouds do not tell it."""
    max_cells: float = 2e9
    """A grid of more cells is refused: at this limit its three arrays take 48 GB."""


@print_in_one_screen
@dataclasses.dataclass(frozen=True)
class Dsm:
    """Heights and σ [rows, columns], north up, NaN: none; `x`, `y`: outer corner of the first cell;
    numbers of points; coordinate system, or None; `own_sigma`: without the errors of orientations,
    where they are known."""

    height: Float[np.ndarray, "rows columns"]
    sigma: Float[np.ndarray, "rows columns"]
    count: Int[np.ndarray, "rows columns"]
    x: float
    y: float
    size: float
    system: str | None = None
    own_sigma: Float[np.ndarray, "rows columns"] | None = None

    def place(self, X: Float[np.ndarray, "n 3"]) -> tuple[np.ndarray, np.ndarray]:
        """Row and column, whole numbers at the centres of cells, of points."""
        return (self.y - X[:, 1]) / self.size - 0.5, (X[:, 0] - self.x) / self.size - 0.5

    def to_xarray(self) -> "xarray.Dataset":
        """Height, σ and number of points over x and y (centres of cells), as an `xarray.Dataset`
        (extra `grids`)."""
        rows, columns = self.height.shape
        x = self.x + (np.arange(columns) + 0.5) * self.size
        y = self.y - (np.arange(rows) + 0.5) * self.size
        dims = ("y", "x")
        return data_set(
            {
                "height": (dims, self.height, ""),
                "sigma": (dims, self.sigma, ""),
                "count": (dims, self.count, "1"),
            },
            {"y": (y, ""), "x": (x, "")},
            crs=self.system,
            cell_size=self.size,
        )

    def centres(self) -> tuple[np.ndarray, np.ndarray]:
        """x and y of all cells."""
        rows, columns = self.height.shape
        return np.meshgrid(
            self.x + (np.arange(columns) + 0.5) * self.size,
            self.y - (np.arange(rows) + 0.5) * self.size,
        )


def check_number_of_cells(
    rows: float, columns: float, size: float, settings: DsmSettings = DsmSettings()
) -> None:
    """**Raises:** `InputError` for more than `settings.max_cells`."""
    if rows * columns > settings.max_cells:
        raise InputError(
            f"a DSM of {rows:.0f} × {columns:.0f} cells of {size:g} is too large; give larger cells"
        )


def make_dsm(
    cloud: Cloud, size: float, fill: int = 2, settings: DsmSettings = DsmSettings()
) -> Dsm:
    """The model with square cells of `size`, their edges at multiples of it; gaps of up to `fill`
    cells from the next height are filled.

    **Raises:** `InputError` for an empty cloud, or too many cells.
    """
    size = positive("size of the cells", size)
    if not len(cloud):
        raise InputError("a DSM needs points; the cloud is empty")
    column, row = np.floor(cloud.X[:, 0] / size), np.floor(-cloud.X[:, 1] / size)
    left, top = column.min(), row.min()
    columns, rows = int(column.max() - left) + 1, int(row.max() - top) + 1
    check_number_of_cells(rows, columns, size, settings)
    cell = ((row - top) * columns + (column - left)).astype(np.int64)
    # Of the points from the centres of their cells.
    x, y = cloud.X[:, 0] - (column + 0.5) * size, cloud.X[:, 1] + (row + 0.5) * size
    Z, sigma_Z = cloud.X[:, 2], cloud.sigma[:, 2]
    if cloud.shared is not None:
        sigma_Z = np.sqrt(np.maximum(sigma_Z**2 - cloud.shared, 0.0))
    points_as_one = _points_that_count_as_one(cloud, cell, settings.window)
    height, sigma = np.full((2, rows, columns), np.nan)
    count = np.zeros((rows, columns), int)
    X = np.stack([x, y, Z])
    cells, *values = _average_cells(cell, X, sigma_Z, columns, size, points_as_one, settings)
    for grid, value in zip((height, sigma, count), values):
        grid.flat[cells] = value
    model = Dsm(height, sigma, count, float(left * size), float(-top * size), size, cloud.system)
    if fill:
        model = _fill(model, fill, settings)
    return model if cloud.shared is None else _add_shared(model, cell, cloud.shared)


def _add_shared(dsm: Dsm, cell: Int[np.ndarray, " n"], shared: Float[np.ndarray, " n"]) -> Dsm:
    """The model with the errors of the orientations in its σ; filled cells have those of the
    nearest cell with points."""
    shape = dsm.height.shape
    number = np.bincount(cell, minlength=dsm.height.size).reshape(shape)
    with np.errstate(invalid="ignore"):
        mean = np.bincount(cell, shared, dsm.height.size).reshape(shape) / number
    filled = np.isfinite(dsm.height) & (number == 0)
    if filled.any():
        nearest = {"return_distances": False, "return_indices": True}
        nearest_cell = np.asarray(ndimage.distance_transform_edt(number == 0, **nearest))
        mean[filled] = mean[tuple(nearest_cell[:, filled])]
    return dataclasses.replace(dsm, sigma=np.sqrt(dsm.sigma**2 + mean), own_sigma=dsm.sigma)


def write_dsm(dsm: Dsm, path: str | Path, sigma_path: str | Path | None = None) -> None:
    """GeoTIFFs of heights and of their σ, float32, no-data `NO_DATA`. Where the σ without the
    errors of the orientations is known, it is the second band of the file of σ. The system of
    heights is that of the file of heights alone."""
    from rasterio.transform import Affine

    profile = {
        "transform": Affine(dsm.size, 0, dsm.x, 0, -dsm.size, dsm.y),
        "nodata": NO_DATA,
        "compress": "deflate",
    }
    rows, columns = dsm.height.shape
    sigmas = {"sigma of height": dsm.sigma}
    if dsm.own_sigma is not None:
        sigmas[OWN_SIGMA] = dsm.own_sigma
    # σ are no heights: with a vertical system gdalwarp would add geoid heights to them
    horizontal = horizontal_system(dsm.system)
    files = (
        (path, {"height": dsm.height}, dsm.system),
        (sigma_path, sigmas, horizontal),
    )
    for target, bands, crs in files:
        if target is not None:
            form = {**profile, "crs": crs}
            with write_raster(target, columns, rows, len(bands), "float32", **form) as raster:
                values = np.stack([*bands.values()])
                raster.write(np.nan_to_num(values, nan=NO_DATA).astype(np.float32))
                raster.describe([*bands])


def _points_that_count_as_one(
    cloud: Cloud, cell: Int[np.ndarray, " n"], window: float
) -> Float[np.ndarray, " cells"]:
    """n/m of every cell with points, in ascending order; 1 without pixels of base images."""
    cells, group = np.unique(cell, return_inverse=True)
    is_known = np.isfinite(cloud.uv).all(1)
    if not is_known.any():
        return np.ones(len(cells))
    group_and_image = group * len(cloud.images) + cloud.image
    order = np.argsort(group_and_image, kind="stable")
    keys, begin, count = np.unique(group_and_image[order], return_index=True, return_counts=True)
    uv = np.where(np.expand_dims(is_known, 1), cloud.uv, np.inf)[order]
    with np.errstate(invalid="ignore"):
        reach = np.maximum.reduceat(uv, begin) - np.minimum.reduceat(uv, begin)
    independent = np.prod(_independent_values(reach / window), axis=1)
    # Without a pixel a point stands for itself.
    independent = np.minimum(np.where(np.isfinite(independent), independent, count), count)
    _, first = np.unique(keys // len(cloud.images), return_index=True)
    return np.add.reduceat(count, first) / np.maximum.reduceat(independent, first)


def _independent_values(length: Float[np.ndarray, "..."]) -> Float[np.ndarray, "..."]:
    """How many independent values have the variance of the mean over a length of values with the
    correlation 1 − |distance| up to 1, and none beyond: t over the integral of that correlation."""
    short, long = np.minimum(length, 1.0), np.maximum(length, 1.0)
    return np.where(length < 1, 1 / (1 - short / 3), 3 * long**2 / (3 * long - 1))


def _average_cells(
    cell: Int[np.ndarray, " n"],
    X: Float[np.ndarray, "3 n"],
    sigma: Float[np.ndarray, " n"],
    columns: int,
    size: float,
    points_as_one: Float[np.ndarray, " cells"],
    settings: DsmSettings,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Cells with points in ascending order, heights at their centres, σ of these, numbers of
    points.

    **Arguments:** `X`: points, x and y from the centre of their cell; `sigma` of their heights;
    `points_as_one`: for each cell with points, how many of them count as one."""
    order = np.lexsort((X[2], cell))
    cell, (x, y, Z), sigma = cell[order], X[:, order], sigma[order]
    cells, begin, count = np.unique(cell, return_index=True, return_counts=True)
    group = np.repeat(np.arange(len(cells)), count)
    middle = _sorted_medians(Z, begin, count)
    deviation = np.abs(Z - middle[group])
    by_deviation = np.lexsort((deviation, group))
    scatter = NORMAL_SIGMA_BY_MAD * _sorted_medians(deviation[by_deviation], begin, count)
    min_scatter = settings.min_spread * size
    keep = deviation <= settings.max_deviation * np.maximum(scatter, min_scatter)[group]
    # A point without σ, or of a σ that no measurement has, 0 or ∞, counts as one of the median σ.
    with np.errstate(divide="ignore", over="ignore", under="ignore"):
        weight = np.where(sigma > 0, 1 / sigma**2, np.nan)
    is_known = np.isfinite(weight) & (weight > 0)
    weight = (
        np.where(is_known, weight, np.median(weight[is_known]) if is_known.any() else 1.0) * keep
    )
    total = np.bincount(group, weight)
    d_x, d_y, mean = (np.bincount(group, weight * a) / total for a in (x, y, Z))
    d = np.stack([d_x, d_y])
    means = CellMeans(cells, columns, size, mean, d, total / points_as_one)
    slope, covariance = cell_slopes(means, settings.slope, settings.step, settings.wall)
    height = mean - np.sum(slope * d, 0)
    residual = Z - height[group] - slope[0, group] * x - slope[1, group] * y
    n = np.bincount(group, keep)
    square = np.bincount(group, weight * residual**2)
    ratio = np.maximum(points_as_one, square / np.maximum(n - 1, 1))
    variance = ratio / total + np.einsum("ik,ijk,jk->k", d, covariance, d)
    return cells, height, np.sqrt(variance) if is_known.any() else np.full(len(cells), np.nan), n


def _sorted_medians(
    values: Float[np.ndarray, " n"],
    begin: Int[np.ndarray, " groups"],
    count: Int[np.ndarray, " groups"],
) -> Float[np.ndarray, " groups"]:
    """Medians of sorted, consecutive groups."""
    low, high = begin + (count - 1) // 2, begin + count // 2
    return (values[low] + values[high]) / 2


def _fill(dsm: Dsm, reach: int, settings: DsmSettings) -> Dsm:
    """Gaps near heights filled by the mean of those around, weighted by distance."""
    is_known = np.isfinite(dsm.height)
    if is_known.all():
        return dsm
    distance = np.asarray(ndimage.distance_transform_edt(~is_known))
    k = np.arange(-2 * reach, 2 * reach + 1)
    # Inverse squares of distances; a cell itself, at distance 0, has no height where this is used.
    kernel = 1 / np.maximum(np.hypot(k[:, None], k), 0.5) ** 2
    weigh = lambda a: ndimage.convolve(np.where(is_known, a, 0.0), kernel, mode="constant")
    weight = weigh(1.0 * is_known)
    gap = ~is_known & (distance <= reach) & (weight > 0)
    # Only cells with heights on opposite sides, not the outer edge.
    around = ndimage.binary_closing(np.pad(is_known, 2 * reach), iterations=reach)
    gap &= around[2 * reach : -2 * reach, 2 * reach : -2 * reach]
    safe = np.where(weight > 0, weight, 1.0)
    # Heights above their mean: squares of large heights would lose the digits of their scatter.
    level = np.nanmean(dsm.height)
    mean, square = weigh(dsm.height - level) / safe, weigh((dsm.height - level) ** 2) / safe
    height = np.where(gap, level + mean, dsm.height)
    at_wall = gap & (square - mean**2 > (settings.wall * dsm.size) ** 2)
    height[at_wall] = _mean_lower_heights(dsm.height, kernel, at_wall, height[at_wall])
    sigma = np.hypot(weigh(dsm.sigma) / safe, settings.slope * dsm.size * distance)
    return dataclasses.replace(dsm, height=height, sigma=np.where(gap, sigma, dsm.sigma))


def _mean_lower_heights(
    height: Float[np.ndarray, "rows columns"],
    kernel: Float[np.ndarray, "w w"],
    is_gap: Bool[np.ndarray, "rows columns"],
    bound: Float[np.ndarray, " k"],
) -> Float[np.ndarray, " k"]:
    """The weighted means of the heights around some cells that are not above a bound each."""
    reach = len(kernel) // 2
    wide = np.pad(height, reach, constant_values=np.nan)
    rows, columns = np.nonzero(is_gap)
    total, weight = np.zeros((2, len(rows)))
    for (i, j), w in np.ndenumerate(kernel):
        neighbours = wide[rows + i, columns + j]
        is_lower = neighbours <= bound
        total += np.where(is_lower, w * neighbours, 0.0)
        weight += w * is_lower
    return total / weight
