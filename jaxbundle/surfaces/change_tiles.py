"""Cells of two surfaces, tile by tile, and the errors that they share.

The equations are those of `change`: L, t̂ and P.
"""

import dataclasses

import numpy as np
from jaxtyping import Bool, Float

from jaxbundle.surfaces.height_cells import CellSource, Grid, Modes

Cells = Bool[np.ndarray, "rows columns"]


@dataclasses.dataclass(frozen=True)
class SurfaceTile:
    """Cells of both surfaces: differences, their own σ, L, which are known; `rows`, `columns`:
    their place, `core`: the place in them of those that no other tile has."""

    d: Grid
    own: Grid
    L: Modes
    known: Cells
    rows: slice
    columns: slice
    core: tuple[slice, slice]

    def in_core(self, cells: Cells) -> Cells:
        """Those of some cells of the tile that are in its core."""
        return self.from_core(cells[self.core])

    def from_core(self, cells: Cells) -> Cells:
        """Cells of the core as those of the tile."""
        in_tile = np.zeros_like(self.known)
        in_tile[self.core] = cells
        return in_tile

    @property
    def place(self) -> tuple[slice, slice]:
        """Where the core is in the whole."""
        return tuple(
            slice(part.start + core.start, part.start + core.stop)
            for part, core in zip((self.rows, self.columns), self.core)
        )  # type: ignore[return-value] of two


@dataclasses.dataclass(frozen=True)
class SurfaceTiles:
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

    def read(self, corner: tuple[int, int]) -> SurfaceTile:
        """A tile, with cells around it."""
        rows, columns = self.parts(corner, self.margin)
        inner = self.parts(corner, 0)
        core = tuple(
            slice(i.start - o.start, i.stop - o.start) for i, o in zip(inner, (rows, columns))
        )
        # The cells around are for the sums of pairs; for slopes `UncertainCells` reads more itself.
        part_before, part_after = (
            self.before.window(rows, columns),
            self.after.window(rows, columns),
        )
        d, own_sigma = (
            part_after.height - part_before.height,
            np.hypot(part_before.sigma, part_after.sigma),
        )
        with np.errstate(invalid="ignore"):
            is_known = np.isfinite(d) & (own_sigma > 0)
        d, own_sigma = np.where(is_known, d, np.nan), np.where(is_known, own_sigma, np.nan)
        modes_before, modes_after = part_before.modes, part_after.modes
        L = (
            modes_after - modes_before
            if self.same_errors
            else np.concatenate([modes_before, modes_after])
        )
        return SurfaceTile(d, own_sigma, np.where(is_known, L, 0.0), is_known, rows, columns, core)  # type: ignore[arg-type] of two


@dataclasses.dataclass
class SharedErrorEquations:
    """LᵀΣ⁻¹L and LᵀΣ⁻¹d of some cells, and their number."""

    matrix: Float[np.ndarray, "k k"]
    right: Float[np.ndarray, " k"]
    cells: int = 0

    def add(self, tile: SurfaceTile, cells: Cells) -> None:
        A = (tile.L[:, cells] / tile.own[cells]).T
        self.matrix += A.T @ A
        self.right += A.T @ (tile.d[cells] / tile.own[cells])
        self.cells += int(cells.sum())

    def solve(
        self, cells_as_one: float
    ) -> tuple[Float[np.ndarray, " k"], Float[np.ndarray, "k k"]]:
        """t̂ and P; `cells_as_one` of the cells count as one."""
        # The identity is the prior of t, whose σ are in L: with fewer stable cells than errors the
        # matrix is regular, too, and t of an error that they do not show is 0.
        P = np.linalg.inv(np.eye(len(self.right)) + self.matrix / cells_as_one)
        return P @ self.right / cells_as_one, P


@dataclasses.dataclass(frozen=True)
class EstimatedSharedErrors:
    """The shared errors that are known, t̂, and P^½; by what the σ of cells are multiplied, in sums
    of many and alone."""

    t: Float[np.ndarray, " k"]
    root: Float[np.ndarray, "k k"]
    scale: float
    tail: float

    @classmethod
    def solve(
        cls, stable: SharedErrorEquations, cells_as_one: float, scale: float, tail: float
    ) -> "EstimatedSharedErrors":
        """From the normal equations of stable cells, of which `cells_as_one` count as one."""
        t, P = stable.solve(cells_as_one * scale**2)
        return cls(t, _root(P).T, scale, tail)

    def __call__(self, tile: SurfaceTile) -> tuple[Grid, Grid, Modes]:
        """d', the σ of cells in sums, and L·P^½ of a tile."""
        d = tile.d - np.tensordot(self.t, tile.L, 1)
        return d, self.scale * tile.own, np.tensordot(self.root, tile.L, 1)


def _root(P: Float[np.ndarray, "k k"]) -> Float[np.ndarray, "k k"]:
    """R with R·Rᵀ = P."""
    values, vectors = np.linalg.eigh(P)
    return vectors * np.sqrt(np.maximum(values, 0.0))
