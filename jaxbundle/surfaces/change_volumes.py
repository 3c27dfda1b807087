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
    read: Callable[[tuple[int, int]], SurfaceTile],
    reduction: EstimatedSharedErrors,
    rho: Float[np.ndarray, "m m"],
) -> tuple[Region, ...]:
    """The volumes of regions, in the order of their labels."""
    sums = {}
    for corner in usable:
        if not labels[tiles.parts(corner, 0)].any():
            continue
        tile = read(corner)
        reduced = reduction(tile)
        mine = np.where(tile.known, labels[tile.rows, tile.columns], 0)
        for label in np.unique(mine[tile.core]).tolist():
            if label:
                one = sums.setdefault(label, VolumeSums(label, len(reduction.t)))
                one.add(tile.core, reduced, mine == label, rho)
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
            slice(max(at[0] - reach, 0), at[-1] + reach + 1)
            for at in (np.flatnonzero(core.any(axis)) for axis in (1, 0))
        )
        core, cells = core[part], cells[part]
        own = np.where(cells, sigma[part], 0.0)
        self.cells += int(core.sum())
        self.sum += float(np.sum(d[part], where=core))
        self.shared += np.sum(LP[:, *part], axis=(1, 2), where=core)
        # ΣΣ ρᵢⱼ·σᵢ·σⱼ by one convolution; i in the core and j also around it, so that pairs across
        # the edges of tiles count twice in all, as within them.
        if min(own.shape) < len(rho):
            beside = ndimage.convolve(own, rho, mode="constant")
        else:
            beside = fftconvolve(own, rho, "same")
        self.variance += float(np.sum(own * beside, where=core))
        self.squares += float(np.sum(own**2, where=core))

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
    kept, found = np.zeros(sign.shape, np.int32), []
    for wanted in (1, -1):
        labels, number = ndimage.label(sign == wanted, np.ones((3, 3)))
        cells, sums = np.zeros(number + 1, int), np.zeros(number + 1)
        for rows in _bands(len(sign)):
            flat = labels[rows].ravel()
            cells += np.bincount(flat, minlength=number + 1)
            sums += np.bincount(flat, np.nan_to_num(d[rows]).ravel(), minlength=number + 1)
        sums[0] = 0.0
        large = [k for k in np.argsort(-np.abs(sums)) if k and cells[k] >= settings.least_cells]
        mine = np.zeros(number + 1, np.int32)
        for k in large[: settings.most_regions]:
            found.append((abs(sums[k]), len(found) + 1))
            mine[k] = len(found)
        for rows in _bands(len(sign)):
            kept[rows] += mine[labels[rows]]
    found.sort(key=lambda pair: -pair[0])
    order = np.zeros(len(found) + 1, np.int32)
    for place, (_, number) in enumerate(found[: settings.most_regions], 1):
        order[number] = place
    for rows in _bands(len(sign)):
        kept[rows] = order[kept[rows]]
    return kept


def _bands(rows: int, together: int = 512) -> Iterator[slice]:
    """Some rows at a time: of 10 000 cells each, 40 MB."""
    return (slice(k, min(k + together, rows)) for k in range(0, rows, together))
