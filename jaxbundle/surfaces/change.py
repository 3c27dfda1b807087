"""Change between two surface models, with the covariance of both carried to every cell.

The height of cell i has an error ε of its own, with σᵢ (matching), and shares the errors of the
orientations with all other cells. These are t ~ N(0, I), with the columns of L,

    e_i = ε_i + Σₖ L_ik·t_k,      L_i = nᵢᵀ·S_i·W,      W·Wᵀ = C of the orientations,

S the derivative of a point by the orientations (`orientation`), n = (−∂z/∂x, −∂z/∂y, 1): on a slope
a horizontal error is one of height. The difference of two models has σ² = σ₁² + σ₂² and
L = [L₁ L₂], or L₂ − L₁ if both are of one adjustment, whose errors they share. Where ground is
known to be stable its differences dₛ determine t (with the prior N(0, I)):

    P = (I + Lₛᵀ·Σₛ⁻¹·Lₛ)⁻¹,    t̂ = P·Lₛᵀ·Σₛ⁻¹·dₛ,    d' = d − L·t̂,    σ_d² = σ² + diag(L·P·Lᵀ).

A cell has changed at the level α if |d'|/σ_d > z = z(1 − α/2). Of n cells without change α·n are
expected to be called changed; within one pair they lie together, as the shared errors do.

Volumes of a region R with cells of the area a, ρ the correlation of errors of their own between
cells, by the distance of these (windows of matching overlap, filters smooth):

    V = a·Σ d'ᵢ,     σ_V² = a²·(s²·ΣΣ ρᵢⱼ·σᵢ·σⱼ + |Σ (L·P^½)ᵢ|²).

ρ is estimated from d'/σ of unchanged cells. With ρ a cell counts as 1/m of one for t̂, m = Σρ. The
scatter of d'/σ multiplies the σ of cells if it is above 1: σ that are too small would call more
than α·n unchanged cells changed. Of n stable cells it follows from their residuals v, of which the
estimated t̂ have taken a part,

    h = mean of L·P·Lᵀ/(s·σ)²,     s² = mean of (v/σ)²/(1 − h),
    q = the quantile 1 − α of |v|/σ, over z·√(1 − h):

s for sums of many cells, that is for volumes and t̂, and q for single cells, whose errors have
longer tails than normal ones. A quantile needs 1/α independent cells, n·(1 − h)/m > 1/α. With
fewer, or without stable ground, both are the scatter by the median, which cells that have changed
do not disturb.

Cells are read and computed tile by tile, since the columns of L of a large surface would not be in
memory: once for the sums of t̂, once for d', σ and w, and again for the tiles of regions; ρ and the
scatter of the cells are those of some tiles.
"""

import dataclasses
from collections.abc import Callable, Mapping
from functools import lru_cache
from typing import Any

import numpy as np
from jaxtyping import Int

from jaxbundle.display import print_in_one_screen
from jaxbundle.errors import InputError
from jaxbundle.leastsquares.quality.distributions import normal_quantile
from jaxbundle.surfaces.change_scatter import sample_of, scatter_of, scatter_of_stable
from jaxbundle.surfaces.change_settings import DEFAULTS, ChangeSettings
from jaxbundle.surfaces.change_tiles import (
    Cells,
    EstimatedSharedErrors,
    SharedErrorEquations,
    SurfaceTile,
    SurfaceTiles,
)
from jaxbundle.surfaces.change_volumes import (
    Region,
    VolumeSums,
    significant_regions,
    volumes_of_regions,
)
from jaxbundle.surfaces.height_cells import CellSource, Grid


@print_in_one_screen
@dataclasses.dataclass(frozen=True)
class SurfaceChange:
    """The change from one surface to another, cell by cell: `difference` (after minus before, less
    the shared errors that stable ground shows), its `sigma`; `sign` of significant cells, −1, 0, 1.

    `limit`: of |w| = |difference|/σ at the `level`; `correlation`: cells that count as one, Σρ;
    `sigma_ratio`: scatter of the cells without shared errors, over their given σ, 1 if these are
    right; by it, if it is larger, σ of volumes are enlarged; `tail_ratio`: the same by the quantile
    at the `level`, for `sigma` and `sign`;
    `modes`: shared errors; `total` and `regions`: volumes."""

    difference: Grid
    sigma: Grid
    sign: Int[np.ndarray, "rows columns"]
    x: float
    y: float
    size: float
    system: str | None
    level: float
    limit: float
    correlation: float
    sigma_ratio: float
    tail_ratio: float
    modes: int
    total: Region
    regions: tuple[Region, ...] = ()

    @property
    def known(self) -> Cells:
        """Which cells have both heights."""
        return np.isfinite(self.difference)

    @property
    def significance(self) -> Grid:
        """The difference over its σ."""
        return self.difference / self.sigma


def find_change(
    before: CellSource,
    after: CellSource,
    level: float = 0.05,
    stable: Cells | None = None,
    labels: Int[np.ndarray, "rows columns"] | None = None,
    same_errors: bool = False,
    settings: ChangeSettings = DEFAULTS,
) -> SurfaceChange:
    """The change between two surfaces of the same cells (`height_cells.align`), in memory
    (`HeightGrid`) or in files.

    **Arguments:** `level` of significance; `stable`: cells known to be unchanged; `labels`: regions
    whose volumes are computed, 0 for none; by default those of significant cells of one sign;
    `same_errors`: the shared errors of both are the same ones, column by column.

    **Raises:** `InputError` if the grids have no common cell with heights, or cells have no σ.
    """
    if not 0 < level < 1:
        raise InputError(f"--level {level:g}: expected a number between 0 and 1, such as 0.05")
    if same_errors and before.shared_errors != after.shared_errors:
        raise InputError("the shared errors of both surfaces are not those of one adjustment")
    k = max(before.shared_errors, after.shared_errors)
    k = k if same_errors else before.shared_errors + after.shared_errors
    side = int(np.sqrt(settings.tile_numbers / (16 + 4 * k)))
    # A tile most of which are cells around it would be slow.
    tiles = SurfaceTiles(before, after, same_errors, max(side, 8 * settings.reach), settings.reach)
    # Of one tile, all three passes use what the first has read; of several only one has room.
    read_tile = lru_cache(1)(tiles.read)
    equations_of_all, equations_of_stable = (
        SharedErrorEquations(np.zeros((k, k)), np.zeros(k)) for _ in range(2)
    )
    known_tiles = _sum_up(tiles, read_tile, equations_of_all, equations_of_stable, stable)
    rho, ratio = scatter_of(known_tiles, read_tile, equations_of_all.solve(1.0)[0], settings)
    # No cell counts for more than one, as an estimate of ρ from few cells may say.
    cells_as_one, limit = max(float(rho.sum()), 1.0), normal_quantile(1 - level / 2)
    enlarge = lambda ratio: max(ratio, 1.0) if settings.enlarge_sigma else 1.0
    reduction = EstimatedSharedErrors(np.zeros(k), np.eye(k), enlarge(ratio), enlarge(ratio))
    tail = ratio
    if stable is not None:
        # Σ of cells is s² times the given one, and only every together-th cell is a new one.
        reduce = lambda s, q: EstimatedSharedErrors.solve(
            equations_of_stable, cells_as_one, enlarge(s), enlarge(q)
        )
        within = [corner for corner in known_tiles if stable[tiles.parts(corner, 0)].any()]
        stable_scatter = scatter_of_stable(
            sample_of(within, settings),
            read_tile,
            stable,
            reduce(ratio, ratio),
            cells_as_one,
            level,
        )
        ratio, tail = stable_scatter if stable_scatter is not None else (ratio, ratio)
        reduction = reduce(ratio, tail)
    # Of several tiles in single precision: half the memory, and 1e-7 of a difference.
    dtype = np.float64 if len(tiles.corners) == 1 else np.float32
    d, sigma = (np.full(before.shape, np.nan, dtype) for _ in range(2))
    sign, total = np.zeros(before.shape, np.int8), VolumeSums(0, k)
    for corner in known_tiles:
        tile = read_tile(corner)
        remainder, own_sigma, LP = reduction(tile)
        s = np.sqrt((reduction.tail * tile.own) ** 2 + np.sum(LP**2, axis=0))
        with np.errstate(invalid="ignore"):
            significant_sign = np.where(np.abs(remainder) > limit * s, np.sign(remainder), 0)
        d[tile.place], sigma[tile.place] = remainder[tile.core], s[tile.core]
        sign[tile.place] = np.where(tile.known, significant_sign, 0)[tile.core]
        total.add(tile.core, (remainder, own_sigma, LP), tile.known, rho)
    if labels is None:
        labels = significant_regions(sign, d, settings)
    regions = volumes_of_regions(labels, known_tiles, tiles, read_tile, reduction, rho)
    return SurfaceChange(
        d,
        sigma,
        sign,
        before.x,
        before.y,
        before.size,
        before.system,
        level,
        limit,
        cells_as_one,
        ratio,
        tail,
        k,
        total.region(before.size),
        regions,
    )


def _sum_up(
    tiles: SurfaceTiles,
    read_tile: Callable[[tuple[int, int]], SurfaceTile],
    equations_of_all: SharedErrorEquations,
    quiet: SharedErrorEquations,
    stable: Cells | None,
) -> list[tuple[int, int]]:
    """The normal equations of t̂ of all cells and of stable ones; the tiles with known cells."""
    usable = []
    for corner in tiles.corners:
        tile = read_tile(corner)
        core = tile.in_core(tile.known)
        if not core.any():
            continue
        usable.append(corner)
        equations_of_all.add(tile, core)
        if stable is not None:
            quiet.add(tile, core & stable[tile.rows, tile.columns])
    if not usable:
        raise InputError(
            "the two surfaces have no cell in common with heights of both and a σ above 0"
        )
    if stable is not None and not quiet.cells:
        raise InputError("--stable: no stable cell has heights of both surfaces")
    return usable


def summary(change: SurfaceChange) -> Mapping[str, Any]:
    """Figures of a change, for JSON."""
    number = change.total.cells
    risen, fallen = (int(np.count_nonzero(change.sign == sign)) for sign in (1, -1))
    return {
        "cells": number,
        "level": change.level,
        "limit": change.limit,
        "significant": (risen + fallen) / number,
        "risen": risen / number,
        "fallen": fallen / number,
        "shared_errors": change.modes,
        "cells_that_count_as_one": change.correlation,
        "sigma_ratio": change.sigma_ratio,
        "tail_ratio": change.tail_ratio,
        "mean_sigma": float(np.nanmean(change.sigma, dtype=float)),
        "total": dataclasses.asdict(change.total),
        "regions": [dataclasses.asdict(region) for region in change.regions],
    }
