"""Heights of a terrain model (DEM) as observations of tie points.

    v = h − [(1−y)·((1−x)·z₀₀ + x·z₀₁) + y·((1−x)·z₁₀ + x·z₁₁)],

h the height of a point, (x, y) its place in the cell of the grid that it is in, z the heights at
the corners of the cell. A solution keeps the cells; they are those of its result, since it is
repeated from there (`declare`). A point that leaves the model keeps the last cell.
"""

import dataclasses
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxbundle.errors import InputError
from jaxbundle.geometry.ellipsoid import Ellipsoid
from jaxbundle.geometry.vectors import Triple, Vector
from jaxbundle.leastsquares.declarations import Kind
from jaxbundle.leastsquares.indexing.indices import fill_up
from jaxbundle.pushbroom.terrain import Cell, Terrain, cell_at, grid_place, height_in_cell
from jaxbundle.system.programs import compile_once
from jaxbundle.types import AnyArray, Scalar

# The set of these observations.
TERRAIN_HEIGHTS = "terrain heights"


class HeightModel(NamedTuple):
    """A terrain model whose heights are observed, σ of a height in metres, its name in messages.

    Heights are above the ellipsoid of the images, or Z of a local frame.
    """

    terrain: Terrain
    sigma: float
    name: str = "terrain model"


@dataclasses.dataclass(frozen=True)
class TerrainHeight:
    """v of the height of a point; the grid is that of a `Terrain`."""

    earth: Ellipsoid | None
    origin: tuple[float, float]
    step: tuple[float, float]
    columns: int

    def place(self, X: Vector) -> Triple:
        """(column, row, height) of a point."""
        return grid_place(X, self.earth, self.origin, self.step, self.columns)

    def __call__(self, X: Vector, cell: Cell) -> tuple[Scalar]:
        column, row, h = self.place(X)
        return (h - height_in_cell(cell, column, row),)


def terrain_height(terrain: Terrain) -> TerrainHeight:
    """The equation of the heights of a terrain model."""
    numbers = lambda pair: (float(pair[0]), float(pair[1]))
    columns = terrain.heights.shape[1]
    return TerrainHeight(terrain.earth, numbers(terrain.origin), numbers(terrain.step), columns)


def terrain_heights(terrain: Terrain) -> Kind:
    """Heights of a terrain model as observations; each may be a blunder: a building, a tree."""
    equation = terrain_height(terrain)
    return Kind(TERRAIN_HEIGHTS, equation, ("point",), ("height",), "length", scalars=True)


@compile_once
def _cells(
    equation: TerrainHeight, heights: Float[AnyArray, "rows columns"], X: Float[AnyArray, "n 3"]
) -> tuple[Cell, Float[Array, " n"]]:
    def of_one(X: Float[AnyArray, "3"]) -> tuple[Cell, Array]:
        column, row, h = equation.place(X)
        # A point on the last line of the grid is in the last cell.
        cell_index = [jnp.where(coordinate == n - 1, n - 2.0, jnp.floor(coordinate))
                for coordinate, n in zip((column, row), heights.shape[::-1])]  # fmt: skip
        cell = cell_at(heights, *cell_index)
        return cell, jnp.asarray(h - height_in_cell(cell, column, row))

    return jax.vmap(of_one)(X)


def find_cells(
    terrain: Terrain, X: Float[np.ndarray, "n 3"]
) -> tuple[Cell, Float[np.ndarray, " n"]]:
    """The cells that points are in, and v there; NaN where the model has no height."""
    n = len(X)
    padded = np.asarray(X)[fill_up(n)]
    cells = _cells(terrain_height(terrain), np.asarray(terrain.heights), padded)
    return jax.tree.map(lambda x: np.asarray(x)[:n], cells)


def choose_covered(
    model: HeightModel, X: Float[np.ndarray, "n 3"]
) -> tuple[Cell, Bool[np.ndarray, " n"]]:
    """The cells of points, and which of these have a height.

    **Raises:** `InputError` if σ is not positive, or no point is on the model.
    """
    if not (np.isfinite(model.sigma) and model.sigma > 0):
        raise InputError(
            f"{model.name}: σ of its heights is {model.sigma:g}; expected metres above 0"
        )
    cells, v = find_cells(model.terrain, X)
    covered = np.isfinite(v)
    if len(v) and not covered.any():
        raise InputError(
            f"{model.name}: none of the {len(v)} tie points is where the terrain model has a "
            "height; give a model that covers the images"
        )
    return cells, covered


def update_cells(
    model: HeightModel, cells: Cell, X: Float[np.ndarray, "n 3"]
) -> tuple[Cell, float]:
    """The cells that points are in now, those before where there is no height; the largest change
    of v by another cell, in units of σ."""
    equation, (cells_now, v) = terrain_height(model.terrain), find_cells(model.terrain, X)
    covered = np.isfinite(v)
    choose = lambda new, old: np.where(covered, new, np.asarray(old))
    updated = jax.tree.map(choose, cells_now, cells)
    misclosures_before = np.asarray(
        _at_cells(equation, np.asarray(X), jax.tree.map(np.asarray, cells))
    )
    change = np.abs(np.where(covered, v - misclosures_before, 0.0)).max(initial=0.0)
    return updated, float(change) / model.sigma


@compile_once
def _at_cells(
    equation: TerrainHeight, X: Float[AnyArray, "n 3"], cells: Cell
) -> Float[Array, " n"]:
    return jnp.asarray(jax.vmap(lambda X, cell: equation(X, cell)[0])(X, cells))
