"""Change between two surface models, with the covariance of both carried to every cell.

The height of cell i has an error ε of its own, with σᵢ (matching), and shares the errors of the
orientations with all other cells. These are t ~ N(0, I), with the columns of L,

    e_i = ε_i + Σₖ L_ik·t_k,      L_i = nᵢᵀ·S_i·W,      W·Wᵀ = C of the orientations,

S the derivative of a point by the orientations (`orientation`), n = (−∂z/∂x, −∂z/∂y, 1): on a slope
a horizontal error is one of height. The difference of two models has σ² = σ₁² + σ₂² and
L = [L₁ L₂], or L₂ − L₁ if both are of one adjustment, whose errors they share. Where ground is
known to be stable its differences dₛ determine t (with the prior N(0, I)):

    P = (I + Lₛᵀ·Σₛ⁻¹·Lₛ)⁻¹,    t̂ = P·Lₛᵀ·Σₛ⁻¹·dₛ,    d' = d − L·t̂,    σ_d² = σ² + diag(L·P·Lᵀ).

A cell has changed at the level α if |d'|/σ_d > z(1 − α/2). Of n cells without change α·n are
expected to be called changed; within one pair they lie together, as the shared errors do.

Volumes of a region R with cells of the area a, ρ the correlation of errors of their own between
cells, by the distance of these (windows of matching overlap, filters smooth):

    V = a·Σ d'ᵢ,     σ_V² = a²·(ΣΣ ρᵢⱼ·σᵢ·σⱼ + |Σ (L·P^½)ᵢ|²).

ρ is estimated from d'/σ of unchanged cells. With ρ a cell counts as 1/Σρ of one for t̂.
"""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy import ndimage
from scipy.signal import fftconvolve
from scipy.stats import norm

from jaxbundle.display import print_in_one_screen
from jaxbundle.errors import InputError
from jaxbundle.surfaces.scatter import robust_sigma

Grid = Float[np.ndarray, "rows columns"]


@print_in_one_screen
@dataclasses.dataclass(frozen=True)
class HeightGrid:
    """Heights of square cells, NaN: none, with the σ of their own and the columns of L, `shared`
    [k, rows, columns], in units of the heights; `x`, `y`: outer corner of the first cell."""

    height: Grid
    sigma: Grid
    x: float
    y: float
    size: float
    system: str | None = None
    shared: Float[np.ndarray, "k rows columns"] | None = None

    @property
    def modes(self) -> Float[np.ndarray, "k rows columns"]:
        """The columns of L, none without shared errors."""
        return np.zeros((0, *self.height.shape)) if self.shared is None else self.shared

    def window(self, rows: slice, columns: slice) -> "HeightGrid":
        """A part of it."""
        return dataclasses.replace(
            self,
            height=self.height[rows, columns],
            sigma=self.sigma[rows, columns],
            x=self.x + columns.start * self.size,
            y=self.y - rows.start * self.size,
            shared=self.modes[:, rows, columns],
        )

    def slopes(self) -> Float[np.ndarray, "2 rows columns"]:
        """∂z/∂x and ∂z/∂y, 0 beside gaps."""
        down, right = (
            np.gradient(self.height, self.size, axis=axis)
            if self.height.shape[axis] > 1
            else np.zeros_like(self.height)
            for axis in (0, 1)
        )
        return np.nan_to_num(np.stack([right, -down]))


def stated_modes(
    grid: HeightGrid, vertical: float = 0.0, horizontal: float = 0.0, tilt: float = 0.0
) -> Float[np.ndarray, "k rows columns"]:
    """The columns of L of stated errors: of a vertical shift, of a horizontal one (σ for each
    axis), of a tilt (radians, about each axis through the middle)."""
    rows, columns = grid.height.shape
    modes = []
    if vertical:
        modes.append(np.full((rows, columns), vertical))
    if horizontal:
        modes += [-horizontal * slope for slope in grid.slopes()]
    if tilt:
        east = (np.arange(columns) - (columns - 1) / 2) * grid.size
        north = ((rows - 1) / 2 - np.arange(rows)) * grid.size
        modes += [tilt * np.broadcast_to(v, (rows, columns)) for v in (east, north[:, None])]
    return np.stack(modes) if modes else np.zeros((0, rows, columns))


@dataclasses.dataclass(frozen=True)
class Region:
    """A region: its label, number of cells, their area, mean difference, volume and its σ."""

    label: int
    cells: int
    area: float
    mean: float
    volume: float
    sigma: float


@print_in_one_screen
@dataclasses.dataclass(frozen=True)
class SurfaceChange:
    """The change from one surface to another, cell by cell: `difference` (after minus before, less
    the shared errors that stable ground shows), its `sigma`; `sign` of significant cells, −1, 0, 1.

    `limit`: of |w| = |difference|/σ at the `level`; `correlation`: cells that count as one, Σρ;
    `sigma_ratio`: scatter of the cells without shared errors, over their σ, 1 if these are right;
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
    modes: int
    total: Region
    regions: tuple[Region, ...] = ()

    @property
    def known(self) -> Bool[np.ndarray, "rows columns"]:
        """Which cells have both heights."""
        return np.isfinite(self.difference)

    @property
    def significance(self) -> Grid:
        """The difference over its σ."""
        return self.difference / self.sigma


@dataclasses.dataclass(frozen=True)
class ChangeSettings:
    """How changes are found."""

    reach: int = 15
    """Cells up to which errors are correlated at most. Twice the windows of dense matching (15
    pixels) divided by two pixels a cell."""
    least_correlation: float = 0.05
    """ρ below which, at the first distance, errors count as uncorrelated: below it its estimate is
    noise, of √(1/n) with n independent cells."""
    least_cells: int = 9
    """Cells of the smallest region of significant ones that is listed: 3 × 3."""
    most_regions: int = 50
    """Regions that are listed, the largest volumes first."""


def find_change(
    before: HeightGrid,
    after: HeightGrid,
    level: float = 0.05,
    stable: Bool[np.ndarray, "rows columns"] | None = None,
    labels: Int[np.ndarray, "rows columns"] | None = None,
    same_errors: bool = False,
    settings: ChangeSettings = ChangeSettings(),
) -> SurfaceChange:
    """The change between two grids of the same cells (`align`).

    **Arguments:** `level` of significance; `stable`: cells known to be unchanged; `labels`: regions
    whose volumes are computed, 0 for none; by default those of significant cells of one sign;
    `same_errors`: the shared errors of both are the same ones, column by column.

    **Raises:** `InputError` if the grids have no common cell with heights, or cells have no σ.
    """
    if not 0 < level < 1:
        raise InputError(f"--level {level:g}: between 0 and 1 is expected, such as 0.05")
    d = after.height - before.height
    known = np.isfinite(d)
    if not known.any():
        raise InputError("the two surfaces have no cell in common with heights of both")
    own = np.hypot(before.sigma, after.sigma)
    known &= own > 0
    if not known.any():
        raise InputError("no common cell has a σ above 0 of both surfaces; give them")
    d, own = np.where(known, d, np.nan), np.where(known, own, np.nan)
    if same_errors and len(before.modes) != len(after.modes):
        raise InputError("the shared errors of both surfaces are not those of one adjustment")
    L = after.modes - before.modes if same_errors else np.concatenate([before.modes, after.modes])
    L = np.where(known, L, 0.0)
    # first what correlates errors of cells: what shared errors explain is none of it
    t, _ = _shared_errors(d, own, L, known, 1.0)
    rest = (d - np.tensordot(t, L, 1)) / own
    quiet = known & (np.abs(rest) < 3 * max(robust_sigma(rest[known]), 1e-300))
    rho = correlation_of(np.where(quiet, rest, 0.0), quiet, settings)
    together = float(rho.sum())
    P = np.eye(len(L))
    if stable is not None:
        if not (known & stable).any():
            raise InputError("--stable: no stable cell has heights of both surfaces")
        t, P = _shared_errors(d, own, L, known & stable, together)
        d = d - np.tensordot(t, L, 1)
    LP = np.tensordot(_root(P).T, L, 1)
    sigma = np.sqrt(own**2 + np.sum(LP**2, axis=0))
    limit = float(norm.ppf(1 - level / 2))
    with np.errstate(invalid="ignore"):
        sign = np.where(np.abs(d) > limit * sigma, np.sign(d), 0).astype(np.int8)
    sign[~known] = 0
    volume = lambda label, cells: _volume(label, cells, (d, own, LP), rho, before.size)
    if labels is None:
        regions = _significant_regions(sign, d, settings, volume)
    else:
        numbers = [int(k) for k in np.unique(labels[known]) if k]
        regions = tuple(volume(k, known & (labels == k)) for k in numbers)
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
        together,
        float(robust_sigma(rest[quiet])),
        len(L),
        volume(0, known),
        regions,
    )


def _shared_errors(
    d: Grid,
    own: Grid,
    L: Float[np.ndarray, "k rows columns"],
    cells: Bool[np.ndarray, "rows columns"],
    together: float,
) -> tuple[Float[np.ndarray, " k"], Float[np.ndarray, "k k"]]:
    """t̂ and P from the differences of some cells; `together` of them count as one."""
    A = (L[:, cells] / own[cells]).T
    P = np.linalg.inv(np.eye(len(L)) + A.T @ A / together)
    return P @ A.T @ (d[cells] / own[cells]) / together, P


def correlation_of(
    w: Grid, known: Bool[np.ndarray, "rows columns"], settings: ChangeSettings = ChangeSettings()
) -> Float[np.ndarray, "2*reach+1 2*reach+1"]:
    """ρ of errors by the distance of cells, 1 in the middle, from normalised residuals.

    Products are averaged over all pairs of known cells at a distance. Beyond the first distance
    where their mean around the middle is below the least correlation they are 0.
    """
    reach = min(settings.reach, *(n - 1 for n in w.shape))
    w = np.where(known, w, 0.0)
    pairs = lambda a: fftconvolve(a, a[::-1, ::-1], "full")[
        w.shape[0] - 1 - reach : w.shape[0] + reach, w.shape[1] - 1 - reach : w.shape[1] + reach
    ]
    number = np.round(pairs(known.astype(float)))
    with np.errstate(invalid="ignore", divide="ignore"):
        rho = np.where(number > 0, pairs(w) / number, 0.0)
    middle = rho[reach, reach]
    rho = rho / middle if middle > 0 else np.zeros_like(rho)
    k = np.arange(-reach, reach + 1)
    distance = np.hypot(k[:, None], k)
    ring = np.rint(distance).astype(int)
    means = ndimage.mean(rho, ring, np.arange(ring.max() + 1))
    low = np.flatnonzero(np.asarray(means) < settings.least_correlation)
    rho[distance >= (low[0] if len(low) else reach) - 0.5] = 0.0
    rho[reach, reach] = 1.0
    return np.maximum(rho, 0.0)


def _volume(
    label: int,
    cells: Bool[np.ndarray, "rows columns"],
    given: tuple[Grid, Grid, Float[np.ndarray, "k rows columns"]],
    rho: Float[np.ndarray, "m m"],
    size: float,
) -> Region:
    """The volume of some cells."""
    rows, columns = (np.flatnonzero(cells.any(axis)) for axis in (1, 0))
    part = slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1)
    inside = cells[part]
    d, own, L = (np.where(inside, a[..., *part], 0.0) for a in given)
    # ΣΣ ρᵢⱼ·σᵢ·σⱼ by one convolution
    variance = float(np.sum(own * fftconvolve(own, rho, "same"))) if min(own.shape) > 0 else 0.0
    if min(own.shape) < len(rho):
        variance = float(np.sum(own * ndimage.convolve(own, rho, mode="constant")))
    shared = L.sum((1, 2))
    number, a = int(inside.sum()), size**2
    return Region(
        label,
        number,
        number * a,
        float(d.sum() / number),
        float(a * d.sum()),
        float(a * np.sqrt(max(variance, 0.0) + shared @ shared)),
    )


def _significant_regions(
    sign: Int[np.ndarray, "rows columns"], d: Grid, settings: ChangeSettings, volume: Any
) -> tuple[Region, ...]:
    """The volumes of connected significant cells of one sign, the largest first."""
    found = []
    for wanted in (1, -1):
        labels, number = ndimage.label(sign == wanted, np.ones((3, 3)))
        cells = np.bincount(labels.ravel(), minlength=number + 1)
        sums = ndimage.sum_labels(np.nan_to_num(d), labels, np.arange(number + 1))
        found += [
            (abs(sums[k]), labels == k)
            for k in np.argsort(-np.abs(sums))[: settings.most_regions + 1]
            if k and cells[k] >= settings.least_cells
        ]
    found.sort(key=lambda pair: -pair[0])
    return tuple(volume(k, cells) for k, (_, cells) in enumerate(found[: settings.most_regions], 1))


def _root(P: Float[np.ndarray, "k k"]) -> Float[np.ndarray, "k k"]:
    """R with R·Rᵀ = P."""
    values, vectors = np.linalg.eigh(P)
    return vectors * np.sqrt(np.maximum(values, 0.0))


def align(
    before: HeightGrid, after: HeightGrid, more: Sequence[HeightGrid] = ()
) -> tuple[HeightGrid, ...]:
    """The common cells of grids, of the first two and `more`.

    **Raises:** `InputError` if they are not on one lattice, or do not overlap.
    """
    grids = before, after, *more
    places = []
    for grid in grids:
        at = (before.y - grid.y) / before.size, (grid.x - before.x) / before.size
        # a hundredth of a cell over the whole grid
        longer = abs(grid.size / before.size - 1) * max(grid.height.shape)
        if longer > 0.01 or max(abs(v - round(v)) for v in at) > 0.01:
            raise InputError(
                f"the cells of {grid.size:g} from ({grid.x:.10g}, {grid.y:.10g}) are not those of "
                f"{before.size:g} from ({before.x:.10g}, {before.y:.10g}); make both with the same "
                "--dsm, whose edges are multiples of it, or resample one (gdalwarp -tap -tr)"
            )
        places.append((round(at[0]), round(at[1])))
    first = [max(p[k] for p in places) for k in (0, 1)]
    last = [min(p[k] + g.height.shape[k] for p, g in zip(places, grids)) for k in (0, 1)]
    if min(last[k] - first[k] for k in (0, 1)) < 1:
        raise InputError("the two surfaces do not overlap: check their coordinate systems")
    return tuple(
        grid.window(*(slice(first[k] - p[k], last[k] - p[k]) for k in (0, 1)))
        for grid, p in zip(grids, places)
    )


def summary(change: SurfaceChange) -> Mapping[str, Any]:
    """Figures of a change, for JSON."""
    number = int(change.known.sum())
    signs = change.sign[change.known]
    return {
        "cells": number,
        "level": change.level,
        "limit": change.limit,
        "significant": float(np.mean(signs != 0)),
        "risen": float(np.mean(signs > 0)),
        "fallen": float(np.mean(signs < 0)),
        "shared_errors": change.modes,
        "cells_that_count_as_one": change.correlation,
        "sigma_ratio": change.sigma_ratio,
        "mean_sigma": float(np.nanmean(change.sigma)),
        "total": dataclasses.asdict(change.total),
        "regions": [dataclasses.asdict(region) for region in change.regions],
    }
