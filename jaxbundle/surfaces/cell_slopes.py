"""Slopes of a surface at the cells of a grid, from planes through neighbouring cells.

A plane is fitted by least squares to the cells of a window of 3 × 3. A cell takes the slope of the
window around it, or, as in edge-preserving filters (Nagao & Matsuyama 1979), of another window with
it that fits significantly better: beside a step, the one that does not contain the step. A priori a
slope is 0 with a known σ, as a further observation of both of its components: it remains where no
window has enough cells, and damps slopes of windows that all fit badly.
"""

import dataclasses
import itertools

import numpy as np
from jaxtyping import Float, Int

# Steps in rows and columns to the cells of a window, its middle first.
WINDOW = tuple(itertools.product((0, -1, 1), repeat=2))


@dataclasses.dataclass(frozen=True)
class CellMeans:
    """Cells with points, by their numbers row by row in ascending order, in a grid of some
    `columns` of cells of a `size`: weighted mean heights of their points, `offset` of the centroids
    of these from the centres of the cells (x, y), and weights 1/σ² of the means."""

    number: Int[np.ndarray, " k"]
    columns: int
    size: float
    height: Float[np.ndarray, " k"]
    offset: Float[np.ndarray, "2 k"]
    weight: Float[np.ndarray, " k"]


def cell_slopes(
    cells: CellMeans, prior: float, step: float, wall: float, at_once: int = 2**17
) -> tuple[Float[np.ndarray, "2 k"], Float[np.ndarray, "2 2 k"]]:
    """∂z/∂x and ∂z/∂y of the cells and their covariances.

    **Arguments:** `prior`: σ of each slope a priori; `step`: ratio of the variance factors of the
    window around a cell and of another with it above which the other is taken; `wall`: standard
    deviation of the heights of a window, in cell sizes, above which it has no slope; `at_once`:
    windows that are computed at a time, whose moments take 32 MB.
    """
    n = len(cells.number)
    slope, covariance = np.empty((2, n)), np.empty((2, 2, n))
    parts = [slice(begin, min(begin + at_once, n)) for begin in range(0, n, at_once)]
    # The last one is that of cells without points, which are no windows.
    normal, right, variance = np.zeros((2, 2, n + 1)), np.zeros((2, n + 1)), np.full(n + 1, np.inf)
    for part in parts:
        normal[..., part], right[:, part], variance[part] = _planes(cells, part, wall)
    preference = np.full((len(WINDOW), 1), step)
    preference[0] = 1.0
    for part in parts:
        windows = _neighbours(cells, part)
        best = np.argmin(preference * variance[windows], axis=0)
        window = np.take_along_axis(windows, best[None], 0)[0]
        # N·s = b and s = 0 ± prior: (prior²·N + σ0²·I)·s = prior²·b
        factor = variance[window]
        factor = np.where(np.isfinite(factor), factor, 1.0)
        inverse = _inverse(prior**2 * normal[..., window] + factor * np.eye(2)[..., None])
        slope[:, part] = prior**2 * np.einsum("ijk,jk->ik", inverse, right[:, window])
        covariance[..., part] = prior**2 * factor * inverse
    return slope, covariance


def _neighbours(cells: CellMeans, part: slice) -> Int[np.ndarray, "9 m"]:
    """Indices of the cells of the windows around some cells; that after the last: none."""
    row, column = np.divmod(cells.number[part], cells.columns)
    found = []
    for row_step, column_step in WINDOW:
        neighbour = (row + row_step) * cells.columns + column + column_step
        index = np.searchsorted(cells.number, neighbour)
        index[cells.number[np.minimum(index, len(cells.number) - 1)] != neighbour] = -1
        is_inside = (column + column_step >= 0) & (column + column_step < cells.columns)
        found.append(np.where(is_inside & (index >= 0), index, len(cells.number)))
    return np.stack(found)


def _planes(
    cells: CellMeans, part: slice, wall: float, least_cells: int = 7
) -> tuple[Float[np.ndarray, "2 2 m"], Float[np.ndarray, "2 m"], Float[np.ndarray, " m"]]:
    """Reduced normal equations N·s = b of the slopes in the windows around some cells, and their
    variance factors: ∞, with N and b of 0, for those with a wall, or of fewer than `least_cells`:
    seven are in all three rows and all three columns, and in two a step cannot be told from a
    slope."""
    moments = np.zeros((4, 4, len(cells.number[part])))
    count = np.zeros(moments.shape[2:])
    extended = lambda values: np.append(values, 0.0)
    weights, heights = extended(cells.weight), extended(cells.height)
    east, north = map(extended, cells.offset)
    for (row_step, column_step), index in zip(WINDOW, _neighbours(cells, part)):
        x, y = column_step * cells.size + east[index], north[index] - row_step * cells.size
        # Above the middle: squares of large heights would lose the digits of their scatter.
        columns = np.stack([np.ones_like(x), x, y, heights[index] - cells.height[part]])
        moments += weights[index] * columns[:, None] * columns
        count += index < len(cells.number)
    reduced = moments[1:, 1:] - moments[1:, :1] * moments[:1, 1:] / moments[0, 0]
    normal, right = reduced[:2, :2], reduced[:2, 2]
    determinant = normal[0, 0] * normal[1, 1] - normal[0, 1] ** 2
    # A cell of far larger weight than the others leaves the slope open but for rounding.
    is_plane = count >= least_cells
    is_plane &= reduced[2, 2] <= (wall * cells.size) ** 2 * moments[0, 0]
    is_plane &= determinant > np.sqrt(np.finfo(float).eps) * normal[0, 0] * normal[1, 1]
    normal, right = np.where(is_plane, normal, 0.0), np.where(is_plane, right, 0.0)
    inverse = _inverse(np.where(is_plane, normal, np.eye(2)[..., None]))
    square = reduced[2, 2] - np.einsum("ik,ijk,jk->k", right, inverse, right)
    # Not below rounding, where cells are exactly in a plane.
    variance = np.maximum(square / np.maximum(count - 3, 1), np.finfo(float).eps)
    return normal, right, np.where(is_plane, variance, np.inf)


def _inverse(matrix: Float[np.ndarray, "2 2 m"]) -> Float[np.ndarray, "2 2 m"]:
    """Inverses of symmetric matrices of two rows."""
    (a, b), (_, c) = matrix
    return np.stack([np.stack([c, -b]), np.stack([-b, a])]) / (a * c - b**2)
