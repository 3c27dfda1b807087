"""Volumes of regions of a change, with their σ; regions of significant cells."""

import dataclasses
from collections.abc import Callable, Iterator

import numpy as np
from jaxtyping import Float, Int
from scipy import ndimage
from scipy.signal import fftconvolve

from jaxbundle.surfaces.change_settings import ChangeSettings
from jaxbundle.surfaces.change_tiles import Cells, EstimatedSharedErrors, SurfaceTile, SurfaceTiles
from jaxbundle.surfaces.height_cells import Grid, Modes


@dataclasses.dataclass(frozen=True)
class Region:
    """A region: its label, number of cells, their area, mean difference, volume and its σ."""

    label: int
    cells: int
    area: float
    mean: float
    volume: float
    sigma: float


def volumes_of_regions(
    labels: Int[np.ndarray, "rows columns"],
    usable: list[tuple[int, int]],
    tiles: SurfaceTiles,
    read_tile: Callable[[tuple[int, int]], SurfaceTile],
    reduction: EstimatedSharedErrors,
    rho: Float[np.ndarray, "m m"],
) -> tuple[Region, ...]:
    """The volumes of regions, in the order of their labels."""
    sums = {}
    for corner in usable:
        if not labels[tiles.parts(corner, 0)].any():
            continue
        tile = read_tile(corner)
        reduced = reduction(tile)
        labels_of_tile = np.where(tile.known, labels[tile.rows, tile.columns], 0)
        for label in np.unique(labels_of_tile[tile.core]).tolist():
            if label:
                sums_of_region = sums.setdefault(label, VolumeSums(label, len(reduction.t)))
                sums_of_region.add(tile.core, reduced, labels_of_tile == label, rho)
    return tuple(sums[label].region(tiles.before.size) for label in sorted(sums))


class VolumeSums:
    """The sums over the cells of a region: their number, d, L·P^½, σᵢ², and ΣΣ ρᵢⱼ·σᵢ·σⱼ."""

    def __init__(self, label: int, k: int) -> None:
        self.label, self.cells, self.sum, self.variance = label, 0, 0.0, 0.0
        self.squares, self.shared = 0.0, np.zeros(k)

    def add(
        self,
        inner: tuple[slice, slice],
        reduced: tuple[Grid, Grid, Modes],
        cells: Cells,
        rho: Float[np.ndarray, "m m"],
    ) -> None:
        """Add those `cells` of a reduced tile that are in its `inner` part, and their pairs with
        all cells."""
        d, sigma, LP = reduced
        core = np.zeros_like(cells)
        core[inner] = cells[inner]
        if not core.any():
            return
        reach = len(rho) // 2
        part = tuple(
            slice(max(rows_or_columns[0] - reach, 0), rows_or_columns[-1] + reach + 1)
            for rows_or_columns in (np.flatnonzero(core.any(axis)) for axis in (1, 0))
        )
        core, cells = core[part], cells[part]
        sigma_of_cells = np.where(cells, sigma[part], 0.0)
        self.cells += int(core.sum())
        self.sum += float(np.sum(d[part], where=core))
        self.shared += np.sum(LP[:, *part], axis=(1, 2), where=core)
        # ΣΣ ρᵢⱼ·σᵢ·σⱼ by one convolution; i in the core and j also around it, so that pairs across
        # the edges of tiles count twice in all, as within them.
        if min(sigma_of_cells.shape) < len(rho):
            weighted_neighbours = ndimage.convolve(sigma_of_cells, rho, mode="constant")
        else:
            weighted_neighbours = fftconvolve(sigma_of_cells, rho, "same")
        self.variance += float(np.sum(sigma_of_cells * weighted_neighbours, where=core))
        self.squares += float(np.sum(sigma_of_cells**2, where=core))

    def region(self, size: float) -> Region:
        """The volume."""
        a = size**2
        # By an estimate of ρ from few cells it may be smaller than without correlation, or even
        # negative.
        variance = max(self.variance, self.squares) + self.shared @ self.shared
        mean, volume = self.sum / self.cells, a * self.sum
        sigma = float(a * np.sqrt(variance))
        return Region(self.label, self.cells, self.cells * a, mean, volume, sigma)


def significant_regions(
    sign: Int[np.ndarray, "rows columns"], d: Grid, settings: ChangeSettings
) -> Int[np.ndarray, "rows columns"]:
    """Connected significant cells of one sign, numbered from the largest sum of differences on."""
    region_of_cell, sizes_and_numbers = np.zeros(sign.shape, np.int32), []
    for wanted_sign in (1, -1):
        labels, number = ndimage.label(sign == wanted_sign, np.ones((3, 3)))
        cells, sums = np.zeros(number + 1, int), np.zeros(number + 1)
        for rows in _bands(len(sign)):
            flat = labels[rows].ravel()
            cells += np.bincount(flat, minlength=number + 1)
            sums += np.bincount(flat, np.nan_to_num(d[rows]).ravel(), minlength=number + 1)
        sums[0] = 0.0
        large = [k for k in np.argsort(-np.abs(sums)) if k and cells[k] >= settings.least_cells]
        number_of_label = np.zeros(number + 1, np.int32)
        for k in large[: settings.most_regions]:
            sizes_and_numbers.append((abs(sums[k]), len(sizes_and_numbers) + 1))
            number_of_label[k] = len(sizes_and_numbers)
        for rows in _bands(len(sign)):
            region_of_cell[rows] += number_of_label[labels[rows]]
    sizes_and_numbers.sort(key=lambda pair: -pair[0])
    order = np.zeros(len(sizes_and_numbers) + 1, np.int32)
    for place, (_, number) in enumerate(sizes_and_numbers[: settings.most_regions], 1):
        order[number] = place
    for rows in _bands(len(sign)):
        region_of_cell[rows] = order[region_of_cell[rows]]
    return region_of_cell


def _bands(rows: int, rows_at_once: int = 512) -> Iterator[slice]:
    """Some rows at a time: of 10 000 cells each, 40 MB."""
    return (slice(k, min(k + rows_at_once, rows)) for k in range(0, rows, rows_at_once))
