"""Surfaces as heights of square cells, in memory or read from files window by window, with the σ of
cells and the errors that cells share."""

import dataclasses
from typing import Protocol

import numpy as np
from jaxtyping import Float

from jaxbundle.arguments import numeric_array
from jaxbundle.display import print_in_one_screen
from jaxbundle.errors import InputError

Grid = Float[np.ndarray, "rows columns"]
Modes = Float[np.ndarray, "k rows columns"]


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
    shared: Modes | None = None

    def __post_init__(self) -> None:
        for name in ("height", "sigma"):
            if isinstance(values := getattr(self, name), np.ma.MaskedArray):
                # A masked cell has no height.
                object.__setattr__(self, name, numeric_array(name, values, "numbers"))

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        rows, columns = self.height.shape
        return rows, columns

    @property
    def modes(self) -> Modes:
        """The columns of L, none without shared errors."""
        return np.zeros((0, *self.height.shape)) if self.shared is None else self.shared

    @property
    def shared_errors(self) -> int:
        """The number of errors that cells share."""
        return len(self.modes)

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

    part = window

    def slopes(self) -> Float[np.ndarray, "2 rows columns"]:
        """∂z/∂x and ∂z/∂y, 0 beside gaps."""
        change_by_row, change_by_column = (
            np.gradient(self.height, self.size, axis=axis)
            if self.height.shape[axis] > 1
            else np.zeros_like(self.height)
            for axis in (0, 1)
        )
        # Rows go south. Beside a gap the slope is unknown: taken as level, since NaN would make all
        # shared errors of the cell NaN.
        return np.nan_to_num(np.stack([change_by_column, -change_by_row]))


class CellSource(Protocol):
    """Cells that are read window by window; attributes as of `HeightGrid`."""

    @property
    def x(self) -> float: ...

    @property
    def y(self) -> float: ...

    @property
    def size(self) -> float: ...

    @property
    def system(self) -> str | None: ...

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        ...

    @property
    def shared_errors(self) -> int:
        """The number of errors that cells share."""
        ...

    def window(self, rows: slice, columns: slice) -> HeightGrid:
        """The cells of a part, with the columns of L."""
        ...

    def part(self, rows: slice, columns: slice) -> "CellSource":
        """A part, not read yet."""
        ...


class SharedErrors(Protocol):
    """Errors that the cells of a surface share."""

    @property
    def number(self) -> int:
        """The number of independent ones."""
        ...

    def __call__(self, grid: HeightGrid) -> Modes:
        """The columns of L of some cells."""
        ...


@dataclasses.dataclass(frozen=True)
class StatedSurfaceErrors:
    """Stated errors of a surface: of a vertical shift, of a horizontal one (σ for each axis), of a
    tilt (radians, about each axis through the `middle`)."""

    middle: tuple[float, float]
    vertical: float = 0.0
    horizontal: float = 0.0
    tilt: float = 0.0

    @property
    def number(self) -> int:
        return (self.vertical > 0) + 2 * (self.horizontal > 0) + 2 * (self.tilt > 0)

    def __call__(self, grid: HeightGrid) -> Modes:
        rows, columns = grid.shape
        modes = []
        if self.vertical:
            modes.append(np.full((rows, columns), self.vertical))
        if self.horizontal:
            # A surface moved by dx has at a place the height z(x − dx) = z − ∂z/∂x·dx.
            modes += [-self.horizontal * slope for slope in grid.slopes()]
        if self.tilt:
            # About the middle: about the origin of a map, 5000 km away, a tilt of 1e-6 would be a
            # shift of 5 m.
            east = grid.x + (np.arange(columns) + 0.5) * grid.size - self.middle[0]
            north = grid.y - (np.arange(rows) + 0.5) * grid.size - self.middle[1]
            directions = (east, north[:, None])
            modes += [self.tilt * np.broadcast_to(v, (rows, columns)) for v in directions]
        return np.stack(modes) if modes else np.zeros((0, rows, columns))


def middle_of(cells: CellSource) -> tuple[float, float]:
    """The coordinates of the middle of a surface."""
    rows, columns = cells.shape
    return cells.x + columns / 2 * cells.size, cells.y - rows / 2 * cells.size


def stated_modes(
    grid: HeightGrid, vertical: float = 0.0, horizontal: float = 0.0, tilt: float = 0.0
) -> Modes:
    """The columns of L of stated errors of a whole surface."""
    return StatedSurfaceErrors(middle_of(grid), vertical, horizontal, tilt)(grid)


@dataclasses.dataclass(frozen=True)
class UncertainCells:
    """A surface with errors that its cells share, computed for a window when it is read."""

    cells: CellSource
    errors: tuple[SharedErrors, ...]

    @property
    def x(self) -> float:
        return self.cells.x

    @property
    def y(self) -> float:
        return self.cells.y

    @property
    def size(self) -> float:
        return self.cells.size

    @property
    def system(self) -> str | None:
        return self.cells.system

    @property
    def shape(self) -> tuple[int, int]:
        return self.cells.shape

    @property
    def shared_errors(self) -> int:
        return self.cells.shared_errors + sum(errors.number for errors in self.errors)

    def window(self, rows: slice, columns: slice) -> HeightGrid:
        """The cells of a part; slopes at its edges are those of the whole."""
        # One cell more on each side, of which the differences at the edges are.
        wide = [
            slice(max(part.start - 1, 0), min(part.stop + 1, n))
            for part, n in zip((rows, columns), self.shape)
        ]
        grid = self.cells.window(*wide)
        modes = [errors(grid) for errors in self.errors]
        grid = dataclasses.replace(grid, shared=np.concatenate([*modes, grid.modes]))
        return grid.window(
            *(
                slice(part.start - w.start, part.stop - w.start)
                for part, w in zip((rows, columns), wide)
            )
        )

    def part(self, rows: slice, columns: slice) -> "UncertainCells":
        return dataclasses.replace(self, cells=self.cells.part(rows, columns))


def align(before: CellSource, after: CellSource) -> tuple[CellSource, CellSource]:
    """The common cells of two grids.

    **Raises:** `InputError` if they are not on one lattice, or do not overlap.
    """
    grids = before, after
    places = [place_of(grid, before) for grid in grids]
    begins = [max(p[k] for p in places) for k in (0, 1)]
    ends = [min(p[k] + g.shape[k] for p, g in zip(places, grids)) for k in (0, 1)]
    if min(ends[k] - begins[k] for k in (0, 1)) < 1:
        raise InputError("the two surfaces do not overlap: check their coordinate systems")
    part_before, part_after = (
        grid.part(*(slice(begins[k] - p[k], ends[k] - p[k]) for k in (0, 1)))
        for grid, p in zip(grids, places)
    )
    return part_before, part_after


def place_of(grid: CellSource, lattice: CellSource) -> tuple[int, int]:
    """The row and the column of the first cell of a grid in another one.

    **Raises:** `InputError` if they are not on one lattice.
    """
    row_and_column = (lattice.y - grid.y) / lattice.size, (grid.x - lattice.x) / lattice.size
    # A hundredth of a cell over the whole grid.
    longer = abs(grid.size / lattice.size - 1) * max(grid.shape)
    if longer > 0.01 or max(abs(v - round(v)) for v in row_and_column) > 0.01:
        raise InputError(
            f"the cells of {grid.size:g} from ({grid.x:.10g}, {grid.y:.10g}) are not those of "
            f"{lattice.size:g} from ({lattice.x:.10g}, {lattice.y:.10g}); make both with the same "
            "--dsm, whose edges are multiples of it, or resample one (gdalwarp -tap -tr)"
        )
    return round(row_and_column[0]), round(row_and_column[1])
