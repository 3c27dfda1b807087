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
from collections.abc import Callable, Iterator, Mapping
from functools import lru_cache
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy import ndimage
from scipy.signal import fftconvolve

from jaxbundle.display import print_in_one_screen
from jaxbundle.errors import InputError
from jaxbundle.leastsquares.quality.distributions import normal_quantile
from jaxbundle.surfaces.height_cells import CellSource, Grid, Modes
from jaxbundle.surfaces.scatter import robust_sigma

Cells = Bool[np.ndarray, "rows columns"]


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


@dataclasses.dataclass(frozen=True)
class ChangeSettings:
    """How changes are found."""

    reach: int = 15
    """Cells up to which errors are correlated at most. Twice the windows of dense matching (15
    pixels) divided by two pixels a cell."""
    least_cells: int = 9
    """Cells of the smallest region of significant ones that is listed: 3 × 3."""
    most_regions: int = 50
    """Regions that are listed, the largest volumes first."""
    reweightings: int = 4
    """Rounds in which shared errors are estimated again from cells that have not changed. With a
    tenth of the area raised by five σ the scatter, 1 in truth, is 1.22 without; 1.12, 1.06, 1.04,
    and after four rounds 1.03."""
    enlarge_sigma: bool = True
    """Whether the given σ of cells are multiplied by their scatter, if that is above 1."""
    tile_numbers: int = 1 << 25
    """Numbers of a tile in memory, 8 bytes each: 256 MB. A cell has about sixteen, and four for
    each error that cells share. Smaller tiles read more cells twice, at their edges."""
    sampled_tiles: int = 16
    """Tiles of which ρ and the scatter of the cells are estimated, evenly spread: of a million
    cells each, of which some ten thousand are independent even with the longest ρ."""


@dataclasses.dataclass(frozen=True)
class _Tile:
    """Cells of both surfaces: differences, their own σ, L, which are known; `rows`, `columns`:
    their place, `core`: the place in them of those that no other tile has."""

    d: Grid
    own: Grid
    L: Modes
    known: Cells
    rows: slice
    columns: slice
    core: tuple[slice, slice]

    @property
    def place(self) -> tuple[slice, slice]:
        """Where the core is in the whole."""
        return tuple(
            slice(part.start + core.start, part.start + core.stop)
            for part, core in zip((self.rows, self.columns), self.core)
        )  # type: ignore[return-value] of two


@dataclasses.dataclass(frozen=True)
class _Tiles:
    """Both surfaces in tiles of `side` cells."""

    before: CellSource
    after: CellSource
    same_errors: bool
    side: int
    margin: int

    @property
    def corners(self) -> list[tuple[int, int]]:
        """The first cell of every tile."""
        rows, columns = (range(0, n, self.side) for n in self.before.shape)
        return [(r, c) for r in rows for c in columns]

    def parts(self, corner: tuple[int, int], margin: int) -> tuple[slice, slice]:
        """The cells of a tile with some around."""
        rows, columns = (
            slice(max(first - margin, 0), min(first + self.side + margin, n))
            for first, n in zip(corner, self.before.shape)
        )
        return rows, columns

    def read(self, corner: tuple[int, int]) -> _Tile:
        """A tile, with cells around it."""
        rows, columns = self.parts(corner, self.margin)
        inner = self.parts(corner, 0)
        core = tuple(
            slice(i.start - o.start, i.stop - o.start) for i, o in zip(inner, (rows, columns))
        )
        # the cells around are for the sums of pairs; for slopes `UncertainCells` reads more itself
        before, after = self.before.window(rows, columns), self.after.window(rows, columns)
        d, own = after.height - before.height, np.hypot(before.sigma, after.sigma)
        with np.errstate(invalid="ignore"):
            known = np.isfinite(d) & (own > 0)
        d, own = np.where(known, d, np.nan), np.where(known, own, np.nan)
        one, two = before.modes, after.modes
        L = two - one if self.same_errors else np.concatenate([one, two])
        return _Tile(d, own, np.where(known, L, 0.0), known, rows, columns, core)  # type: ignore[arg-type] of two


@dataclasses.dataclass
class _NormalEquations:
    """LᵀΣ⁻¹L and LᵀΣ⁻¹d of some cells, and their number."""

    matrix: Float[np.ndarray, "k k"]
    right: Float[np.ndarray, " k"]
    cells: int = 0

    def add(self, tile: _Tile, cells: Cells) -> None:
        A = (tile.L[:, cells] / tile.own[cells]).T
        self.matrix += A.T @ A
        self.right += A.T @ (tile.d[cells] / tile.own[cells])
        self.cells += int(cells.sum())

    def solve(self, together: float) -> tuple[Float[np.ndarray, " k"], Float[np.ndarray, "k k"]]:
        """t̂ and P; `together` of the cells count as one."""
        # the identity is the prior of t, whose σ are in L: with fewer stable cells than errors the
        # matrix is regular, too, and t of an error that they do not show is 0
        P = np.linalg.inv(np.eye(len(self.right)) + self.matrix / together)
        return P @ self.right / together, P


def find_change(
    before: CellSource,
    after: CellSource,
    level: float = 0.05,
    stable: Cells | None = None,
    labels: Int[np.ndarray, "rows columns"] | None = None,
    same_errors: bool = False,
    settings: ChangeSettings = ChangeSettings(),
) -> SurfaceChange:
    """The change between two surfaces of the same cells (`height_cells.align`), in memory
    (`HeightGrid`) or in files.

    **Arguments:** `level` of significance; `stable`: cells known to be unchanged; `labels`: regions
    whose volumes are computed, 0 for none; by default those of significant cells of one sign;
    `same_errors`: the shared errors of both are the same ones, column by column.

    **Raises:** `InputError` if the grids have no common cell with heights, or cells have no σ.
    """
    if not 0 < level < 1:
        raise InputError(f"--level {level:g}: between 0 and 1 is expected, such as 0.05")
    if same_errors and before.shared_errors != after.shared_errors:
        raise InputError("the shared errors of both surfaces are not those of one adjustment")
    k = max(before.shared_errors, after.shared_errors)
    k = k if same_errors else before.shared_errors + after.shared_errors
    side = int(np.sqrt(settings.tile_numbers / (16 + 4 * k)))
    # a tile of which the cells around are most would be slow
    tiles = _Tiles(before, after, same_errors, max(side, 8 * settings.reach), settings.reach)
    # of one tile, all three passes use what the first has read; of several only one has room
    read = lru_cache(1)(tiles.read)
    every, quiet = (_NormalEquations(np.zeros((k, k)), np.zeros(k)) for _ in range(2))
    usable = _sum_up(tiles, read, every, quiet, stable)
    rho, ratio = _scatter_of(usable, read, every.solve(1.0)[0], settings)
    # more than one cell no cell can count for; in few cells the estimate of ρ says so
    together, limit = max(float(rho.sum()), 1.0), normal_quantile(1 - level / 2)
    enlarge = lambda ratio: max(ratio, 1.0) if settings.enlarge_sigma else 1.0
    reduction = _Reduction(np.zeros(k), np.eye(k), enlarge(ratio), enlarge(ratio))
    tail = ratio
    if stable is not None:
        # Σ of cells is s² times the given one, and only every together-th cell is a new one
        reduce = lambda s, q: _Reduction.solve(quiet, together, enlarge(s), enlarge(q))
        within = [corner for corner in usable if stable[tiles.parts(corner, 0)].any()]
        found = _scatter_of_stable(
            _sample(within, settings), read, stable, reduce(ratio, ratio), together, level
        )
        ratio, tail = found if found is not None else (ratio, ratio)
        reduction = reduce(ratio, tail)
    # of several tiles in single precision: half the memory, and 1e-7 of a difference
    dtype = np.float64 if len(tiles.corners) == 1 else np.float32
    d, sigma = (np.full(before.shape, np.nan, dtype) for _ in range(2))
    sign, total = np.zeros(before.shape, np.int8), _VolumeSums(0, k)
    for corner in usable:
        tile = read(corner)
        rest, own, LP = reduction(tile)
        s = np.sqrt((reduction.tail * tile.own) ** 2 + np.sum(LP**2, axis=0))
        with np.errstate(invalid="ignore"):
            sure = np.where(np.abs(rest) > limit * s, np.sign(rest), 0)
        d[tile.place], sigma[tile.place] = rest[tile.core], s[tile.core]
        sign[tile.place] = np.where(tile.known, sure, 0)[tile.core]
        total.add(tile.core, (rest, own, LP), tile.known, rho)
    if labels is None:
        labels = _significant_labels(sign, d, settings)
    regions = _volumes(labels, usable, tiles, read, reduction, rho)
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
        ratio,
        tail,
        k,
        total.region(before.size),
        regions,
    )


@dataclasses.dataclass(frozen=True)
class _Reduction:
    """The shared errors that are known, t̂, and P^½; by what the σ of cells are multiplied, in sums
    of many and alone."""

    t: Float[np.ndarray, " k"]
    root: Float[np.ndarray, "k k"]
    scale: float
    tail: float

    @classmethod
    def solve(
        cls, stable: _NormalEquations, together: float, scale: float, tail: float
    ) -> "_Reduction":
        """From the normal equations of stable cells, of which `together` count as one."""
        t, P = stable.solve(together * scale**2)
        return cls(t, _root(P).T, scale, tail)

    def __call__(self, tile: _Tile) -> tuple[Grid, Grid, Modes]:
        """d', the σ of cells in sums, and L·P^½ of a tile."""
        d = tile.d - np.tensordot(self.t, tile.L, 1)
        return d, self.scale * tile.own, np.tensordot(self.root, tile.L, 1)


def _volumes(
    labels: Int[np.ndarray, "rows columns"],
    usable: list[tuple[int, int]],
    tiles: _Tiles,
    read: Callable[[tuple[int, int]], _Tile],
    reduction: _Reduction,
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
                one = sums.setdefault(label, _VolumeSums(label, len(reduction.t)))
                one.add(tile.core, reduced, mine == label, rho)
    return tuple(sums[label].region(tiles.before.size) for label in sorted(sums))


def _sum_up(
    tiles: _Tiles,
    read: Callable[[tuple[int, int]], _Tile],
    every: _NormalEquations,
    quiet: _NormalEquations,
    stable: Cells | None,
) -> list[tuple[int, int]]:
    """The normal equations of t̂ of all cells and of stable ones; the tiles with known cells."""
    usable, heights = [], False
    for corner in tiles.corners:
        tile = read(corner)
        core = np.zeros_like(tile.known)
        core[tile.core] = tile.known[tile.core]
        heights = heights or bool(core.any())
        if not core.any():
            continue
        usable.append(corner)
        every.add(tile, core)
        if stable is not None:
            quiet.add(tile, core & stable[tile.rows, tile.columns])
    if not usable:
        raise InputError(
            "the two surfaces have no cell in common with heights of both and a σ above 0"
        )
    if stable is not None and not quiet.cells:
        raise InputError("--stable: no stable cell has heights of both surfaces")
    return usable


def _scatter_of(
    usable: list[tuple[int, int]],
    read: Callable[[tuple[int, int]], _Tile],
    t: Float[np.ndarray, " k"],
    settings: ChangeSettings,
) -> tuple[Float[np.ndarray, "2*reach+1 2*reach+1"], float]:
    """ρ of cells by their distance, and the scatter of cells over their σ, from some tiles: without
    what shared errors explain, which is no correlation of cells."""
    chosen = _sample(usable, settings)
    fields, quiet = _quiet_cells(chosen, read, t)
    # changed cells would bend t, and what is left of shared errors would pass for scatter
    for _ in range(settings.reweightings):
        unchanged = _NormalEquations(np.zeros((len(t), len(t))), np.zeros(len(t)))
        for corner, cells in zip(chosen, quiet):
            tile = read(corner)
            core = np.zeros_like(tile.known)
            core[tile.core] = cells
            unchanged.add(tile, core)
        fields, quiet = _quiet_cells(chosen, read, unchanged.solve(1.0)[0])
    rho = correlation_of([np.where(q, f, 0.0) for f, q in zip(fields, quiet)], quiet, settings)
    return rho, float(robust_sigma(np.concatenate([f[q] for f, q in zip(fields, quiet)])))


def _sample(corners: list[tuple[int, int]], settings: ChangeSettings) -> list[tuple[int, int]]:
    """Some tiles, evenly spread."""
    number = min(len(corners), settings.sampled_tiles)
    return [corners[k] for k in np.unique(np.linspace(0, len(corners) - 1, number).astype(int))]


def _scatter_of_stable(
    corners: list[tuple[int, int]],
    read: Callable[[tuple[int, int]], _Tile],
    stable: Cells,
    reduction: "_Reduction",
    together: float,
    level: float,
) -> tuple[float, float] | None:
    """s and q from the residuals of stable cells; None for too few."""
    residuals, shares = [], []
    for corner in corners:
        tile = read(corner)
        d, sigma, LP = reduction(tile)
        cells = np.zeros_like(tile.known)
        cells[tile.core] = (tile.known & stable[tile.rows, tile.columns])[tile.core]
        residuals.append(np.abs(d[cells] / sigma[cells]))
        shares.append(np.sum(LP[:, cells] ** 2, axis=0) / sigma[cells] ** 2)
    v, h = np.concatenate(residuals), float(np.mean(np.concatenate(shares)))
    if len(v) * (1 - h) / together <= 1 / level:
        return None
    s = np.sqrt(np.mean(v**2) / (1 - h))
    q = np.quantile(v, 1 - level) / (normal_quantile(1 - level / 2) * np.sqrt(1 - h))
    return float(reduction.scale * s), float(reduction.scale * q)


def _quiet_cells(
    corners: list[tuple[int, int]],
    read: Callable[[tuple[int, int]], _Tile],
    t: Float[np.ndarray, " k"],
) -> tuple[list[Grid], list[Cells]]:
    """Of every tile the differences over their σ, without what shared errors explain, and which
    cells are not beyond three times their scatter."""
    fields = []
    for corner in corners:
        tile = read(corner)
        rest = ((tile.d - np.tensordot(t, tile.L, 1)) / tile.own)[tile.core]
        fields.append(rest if len(corners) == 1 else rest.astype(np.float32))
    of_cells = np.concatenate([f[np.isfinite(f)] for f in fields])
    most = 3 * robust_sigma(of_cells)
    # unchanged cells are about 0; if most cells have changed together none may be, and those about
    # their median show the same scatter. At least half of them are within one σ there: never none,
    # of which the scatter, and with it every σ, would be NaN
    middle = float(np.median(of_cells))
    if abs(middle) > most:
        fields = [f - middle for f in fields]
    with np.errstate(invalid="ignore"):
        return fields, [np.abs(f) <= most for f in fields]


def correlation_of(
    w: Grid | list[Grid],
    known: Cells | list[Cells],
    settings: ChangeSettings = ChangeSettings(),
) -> Float[np.ndarray, "2*reach+1 2*reach+1"]:
    """ρ of errors by the distance of cells, 1 in the middle, from normalised residuals of a grid,
    or of several parts.

    Products are averaged over all pairs of known cells at a distance, up to a quarter of the sides:
    beyond it there are too few (Box and Jenkins, 1976). Errors of matching are correlated in
    stripes, too, where a slope passes through the pixels, and negatively half a stripe apart: no
    distance or sign is left out, since sums of many cells depend on all.
    """
    parts = list(zip(w, known)) if isinstance(w, list) else [(w, known)]
    shape = np.max([np.shape(a) for a, _ in parts], axis=0)
    reach = min(settings.reach, *((n - 1) // 4 for n in shape))
    total, number = np.zeros((2, 2 * reach + 1, 2 * reach + 1))
    for a, inside in parts:
        total += _pairs(np.where(inside, a, 0.0), reach)
        # counts: what FFT leaves of a 0 would be a divisor
        number += np.round(_pairs(np.asarray(inside, float), reach))
    with np.errstate(invalid="ignore", divide="ignore"):
        rho = np.where(number > 0, total / number, 0.0)
    # over its value in the middle, so that σ given too large or small do not count
    middle = rho[reach, reach]
    rho = rho / middle if middle > 0 else np.zeros_like(rho)
    k = np.arange(-reach, reach + 1)
    rho[np.hypot(k[:, None], k) > reach] = 0.0
    rho[reach, reach] = 1.0
    return rho


def _pairs(a: Grid, reach: int) -> Float[np.ndarray, "m m"]:
    """Sums of the products of all pairs of cells by their distance."""
    # a tile at the edge may be smaller than the reach, which is that of the largest
    a = np.pad(a, [(0, max(reach + 1 - n, 0)) for n in a.shape])
    around = tuple(slice(n - 1 - reach, n + reach) for n in a.shape)
    return fftconvolve(a, a[::-1, ::-1], "full")[around]


class _VolumeSums:
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
        # the edges of tiles count twice in all, as within them
        if min(own.shape) < len(rho):
            beside = ndimage.convolve(own, rho, mode="constant")
        else:
            beside = fftconvolve(own, rho, "same")
        self.variance += float(np.sum(own * beside, where=core))
        self.squares += float(np.sum(own**2, where=core))

    def region(self, size: float) -> Region:
        """The volume."""
        a = size**2
        # by an estimate of ρ from few cells it may be smaller than without correlation, or negative
        variance = max(self.variance, self.squares) + self.shared @ self.shared
        mean, volume = self.sum / self.cells, a * self.sum
        sigma = float(a * np.sqrt(variance))
        return Region(self.label, self.cells, self.cells * a, mean, volume, sigma)


def _significant_labels(
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


def _root(P: Float[np.ndarray, "k k"]) -> Float[np.ndarray, "k k"]:
    """R with R·Rᵀ = P."""
    values, vectors = np.linalg.eigh(P)
    return vectors * np.sqrt(np.maximum(values, 0.0))


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
