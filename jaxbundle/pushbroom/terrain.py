"""A terrain model: the first intersection of a ray with a bilinear surface over a grid.

Between the highest and the lowest height of the model a ray is, in the coordinates of the grid
(column x, row y, height h), a curve near a straight line. Through three exact points it is a
parabola in τ, within a millimetre over ten kilometres. It is followed from cell to cell (Amanatides
and Woo, 1987). In a cell

    f(τ) = h(τ) − [(1−v)·((1−u)·z₀₀ + u·z₀₁) + v·((1−u)·z₁₀ + u·z₁₁)]

is a parabola too, and its first root, if any, is the first intersection: neither the back of a
ridge is hit nor a peak between two samples missed. One Newton step on the exact
coordinates puts the point on ray and surface and provides the derivatives.

Where the model has no height, also beyond its edges, a ray continues: the sea, or a clipped area,
is seldom higher than the terrain behind it. A ray that leaves such an area below the terrain has
met the ground inside it and has no point. One that leaves above continues to its intersection,
which unknown terrain could hide: `over_voids=False` stops these rays, and the difference shows the
affected points.

The grid is regular in longitude and latitude (`earth` an ellipsoid of revolution, heights above
it), or in X and Y of a local frame (`earth` None).
"""

from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.lax import stop_gradient
from jaxtyping import Array, Bool, Float

from jaxbundle.arguments import numeric_array
from jaxbundle.errors import InputError
from jaxbundle.geometry.ellipsoid import WGS84, Ellipsoid, at_height, geodetic, ray_to_ellipsoid
from jaxbundle.geometry.vectors import Scalar, Triple, Vector, point_on_ray
from jaxbundle.implicit import implicit_root, solve_dense
from jaxbundle.pushbroom.polynomial import value, value_and_rate
from jaxbundle.pushbroom.surfaces import GroundSurface
from jaxbundle.types import AnyArray, Numbers

# Column and row at which a cell begins, the heights of its corners z₀₀, z₀₁, z₁₀, z₁₁.
Cell = tuple[AnyArray, AnyArray, tuple[Array, ...]]
# The coefficients of one coordinate in τ, from the constant upwards.
Parabola = Triple
Path = tuple[Parabola, Parabola, Parabola]
# τ, that of the hit (NaN: none), whether the last cell had no heights, whether the traversal ends
TraversalState = tuple[AnyArray, AnyArray, AnyArray, AnyArray]


class Terrain(GroundSurface):
    """Heights at (x, y) = (x₀ + column·dx, y₀ + row·dy): radians, or metres in a local frame.

    NaN: no height. A ray that would hit in such a cell, or beyond the grid, has no point; with
    `over_voids` false neither has a ray that passes over such a cell before.
    """

    iterative: ClassVar[bool] = True
    heights: Float[AnyArray, "rows columns"]
    origin: tuple[float, float]
    step: tuple[float, float]
    lowest: float
    highest: float
    earth: Ellipsoid | None = eqx.field(static=True, default=WGS84)
    over_voids: bool = eqx.field(static=True, default=True)

    def distance(self, o: Vector, d: Vector) -> Scalar:
        start = o, d
        fixed, o, d = stop_gradient((self, o, d))
        top, bottom = fixed._slab(o, d)
        path = fixed._path(o, d, top, bottom)
        tau = _first_hit(path, fixed.heights, self.over_voids)
        s = top + tau * (bottom - top)
        slope = _rate(path, tau, fixed.heights) / (bottom - top)
        # Newton's step on the exact coordinates; derivatives go around the traversal
        s = s - _above_ground(s, None, (fixed, o, d)) / slope
        return implicit_root(_above_ground, solve_dense, s, None, (self, *start))

    def grid(self, X: Vector) -> Triple:
        """(column, row, height) of a point."""
        columns = self.heights.shape[1]
        return grid_place(X, self.earth, self.origin, self.step, columns)

    def _slab(self, o: Vector, d: Vector) -> tuple[Scalar, Scalar]:
        """Where the ray enters and leaves the slab of all heights."""
        # A metre wider: more than the 6e-6·h by which an ellipsoid with longer axes leaves the
        # surface of height h.
        highest, lowest = self.highest + 1.0, self.lowest - 1.0
        if self.earth is None:
            top = (highest - o[2]) / d[2]
            bottom = (lowest - o[2]) / d[2]
            return jnp.maximum(top, 0), jnp.where(bottom > 0, bottom, jnp.nan)
        top = ray_to_ellipsoid(at_height(self.earth, highest), o, d)
        bottom = ray_to_ellipsoid(at_height(self.earth, lowest), o, d)
        # A camera within the slab sees its top only behind the bottom.
        return jnp.where(top < bottom, top, 0.0), bottom

    def _path(self, o: Vector, d: Vector, top: Scalar, bottom: Scalar) -> Path:
        """Coefficients of (x, y, h) as parabolas in τ, from the top (0) to the bottom (1)."""
        ends = [
            self.grid(point_on_ray(o, d, top + tau * (bottom - top))) for tau in (0.0, 0.5, 1.0)
        ]
        x, y, h = ((a, 4 * b - 3 * a - c, 2 * (a + c) - 4 * b) for a, b, c in zip(*ends))
        return x, y, h


def grid_place(
    X: Vector, earth: Ellipsoid | None, origin: Numbers, step: Numbers, columns: int
) -> Triple:
    """(column, row, height) of a point in a grid of so many `columns`; see `Terrain`."""
    x, y, h = X if earth is None else geodetic(earth, X)
    dx = x - origin[0]
    if earth is not None:
        # A turn more or less: the grid may cross the date line.
        middle = step[0] * (columns - 1) / 2
        dx = dx - 2 * np.pi * jnp.round((dx - middle) / (2 * np.pi))
    return dx / step[0], (y - origin[1]) / step[1], h


def make_terrain(
    heights: Float[np.ndarray, "rows columns"],
    origin: Numbers,
    step: Numbers,
    earth: Ellipsoid | None = WGS84,
    over_voids: bool = True,
) -> Terrain:
    """A terrain model of heights in metres, the first at `origin`, columns and rows `step` apart.

    **Arguments:** `over_voids`: rays pass over cells without a height, and come from beyond the
    edges.

    Masked heights are none.

    **Raises:** `InputError` for fewer than 2 × 2 heights, or without any valid height.
    """
    heights = numeric_array("heights", heights, "heights [rows, columns]").astype(float, copy=False)
    if heights.ndim != 2 or min(heights.shape) < 2:
        raise InputError(f"terrain: heights of shape {heights.shape}; a grid of 2 × 2 at least")
    if not np.isfinite(heights).any():
        raise InputError("terrain: no valid height; give a model that covers the image")
    # Infinite heights, as some files mark voids, would pass for terrain.
    heights = np.where(np.isfinite(heights), heights, np.nan)
    low, high = float(np.nanmin(heights)), float(np.nanmax(heights))
    (x, y), (dx, dy) = origin, step
    return Terrain(
        heights=jnp.asarray(heights),
        origin=(float(x), float(y)),
        step=(float(dx), float(dy)),
        lowest=low,
        highest=high,
        earth=earth,
        over_voids=over_voids,
    )


def _above_ground(s: Scalar, _: None, data: tuple[Terrain, Vector, Vector]) -> Scalar:
    """The height above the terrain at the distance s along a ray."""
    terrain, o, d = data
    x, y, h = terrain.grid(point_on_ray(o, d, s))
    return h - bilinear(terrain.heights, x, y)


def bilinear(heights: Float[AnyArray, "rows columns"], x: Scalar, y: Scalar) -> Scalar:
    """The height at column x and row y; NaN outside the grid and where a corner has none."""
    cell = cell_at(heights, jnp.floor(x), jnp.floor(y))
    return height_in_cell(cell, x, y)


def cell_at(heights: Float[AnyArray, "rows columns"], x: AnyArray, y: AnyArray) -> Cell:
    """The heights at the corners of the cell that begins at column x, row y; NaN off the grid."""
    rows, columns = heights.shape
    i, j = y.astype(int), x.astype(int)
    is_inside = (i >= 0) & (i < rows - 1) & (j >= 0) & (j < columns - 1)
    i, j = jnp.clip(i, 0, rows - 2), jnp.clip(j, 0, columns - 2)
    corners = heights[i, j], heights[i, j + 1], heights[i + 1, j], heights[i + 1, j + 1]
    return x, y, tuple(jnp.where(is_inside, z, jnp.nan) for z in corners)


def height_in_cell(cell: Cell, x: Scalar, y: Scalar) -> Scalar:
    """The bilinear surface of a cell at column x and row y, continued beyond the cell."""
    x0, y0, (z00, z01, z10, z11) = cell
    u, v = x - x0, y - y0
    return (1 - v) * ((1 - u) * z00 + u * z01) + v * ((1 - u) * z10 + u * z11)


def _rate(path: Path, tau: Scalar, heights: Float[AnyArray, "rows columns"]) -> Scalar:
    """∂(h − bilinear)/∂τ."""
    (x, dx), (y, dy), (h, dh) = (value_and_rate(p, tau) for p in path)
    x0, y0, (z00, z01, z10, z11) = cell_at(heights, jnp.floor(x), jnp.floor(y))
    u, v = x - x0, y - y0
    along_x = (1 - v) * (z01 - z00) + v * (z11 - z10)
    along_y = (1 - u) * (z10 - z00) + u * (z11 - z01)
    return dh - along_x * dx - along_y * dy


def _first_hit(path: Path, heights: Float[AnyArray, "rows columns"], over_voids: bool) -> Scalar:
    """τ in [0, 1] of the first intersection, cell by cell; NaN if there is none."""
    rows, columns = heights.shape
    px, py, ph = path
    speed = jnp.abs(px[1]) + jnp.abs(py[1])
    # A billionth of a cell: at a border, where rounding may leave the ray in the old cell, the
    # traversal still advances.
    min_advance = 1e-9 / jnp.maximum(speed, 1.0)

    def border(p: Parabola, tau: Scalar) -> Scalar:
        """Where the coordinate reaches the next line of the grid."""
        x, rate = value_and_rate(p, tau)
        target = jnp.where(rate > 0, jnp.floor(x) + 1, jnp.ceil(x) - 1)
        step = (target - x) / jnp.where(rate == 0, 1, rate)
        return jnp.where(rate == 0, jnp.inf, tau + step)

    def step(state: TraversalState) -> TraversalState:
        tau, hit, void, _ = state
        exit_tau = jnp.clip(jnp.minimum(border(px, tau), border(py, tau)), tau + min_advance, 1.0)
        middle = (tau + exit_tau) / 2
        x, y = value(px, middle), value(py, middle)
        cell = cell_at(heights, jnp.floor(x), jnp.floor(y))
        f = [
            value(ph, t) - height_in_cell(cell, value(px, t), value(py, t))
            for t in (tau, middle, exit_tau)
        ]
        part = _first_root(*f)
        # Below the terrain where heights begin again: it was met in the void.
        is_below = void & (f[0] < 0)
        # A corner without height makes all of the cell NaN, so that the middle decides.
        void = jnp.isnan(f[1])
        is_hit = (part <= 1) & ~is_below
        is_done = (
            is_hit
            | is_below
            | (exit_tau >= 1)
            | _has_left_grid(px, x, columns)
            | _has_left_grid(py, y, rows)
        )
        if not over_voids:
            is_done = is_done | void
        return exit_tau, jnp.where(is_hit, tau + part * (exit_tau - tau), jnp.nan), void, is_done

    start = jnp.maximum(_entry_tau(px, columns), _entry_tau(py, rows))
    is_beside = jnp.isnan(speed) | ~(start < 1)
    if not over_voids:
        is_beside = is_beside | (start > 0)
    state = start, jnp.full_like(speed, jnp.nan), start > 0, is_beside
    return jax.lax.while_loop(lambda s: ~s[3], step, state)[1]


def _has_left_grid(p: Parabola, x: Scalar, size: int) -> Bool[Array, ""]:
    """Whether a coordinate is off the grid and does not come back."""
    return jnp.where(p[1] > 0, x > size - 1, x < 0)


def _entry_tau(p: Parabola, size: int) -> Scalar:
    """τ where a coordinate comes to the grid, 0 if it is there at first, ∞ if it never is."""
    target = jnp.where(p[0] < 0, 0.0, size - 1.0)
    tau = jnp.zeros_like(p[0])
    # Newton's method; the parabola is nearly straight, and three steps are exact to rounding
    for _ in range(3):
        x, rate = value_and_rate(p, tau)
        tau = tau + (target - x) / jnp.where(rate == 0, jnp.nan, rate)
    is_outside = (p[0] < 0) | (p[0] > size - 1)
    return jnp.where(is_outside, jnp.where(tau > 0, tau, jnp.inf), 0.0)


def _first_root(f0: Scalar, fm: Scalar, f1: Scalar) -> Scalar:
    """The first w in [0, 1] where the parabola through (0, f0), (½, fm), (1, f1) is 0; else ∞."""
    a = 2 * (f0 + f1) - 4 * fm
    b = f1 - f0 - a
    discriminant = b * b - 4 * a * f0
    root = jnp.sqrt(jnp.maximum(discriminant, 0))
    # Of the two forms of a root the one without cancellation (Press et al., 2007, section 5.6).
    q = -(b + jnp.where(b < 0, -root, root)) / 2
    root1 = q / jnp.where(a == 0, jnp.nan, a)
    root2 = f0 / jnp.where(q == 0, jnp.nan, q)
    within = lambda w: jnp.where((w >= 0) & (w <= 1), w, jnp.inf)
    smallest = jnp.minimum(within(root1), within(root2))
    return jnp.where(discriminant < 0, jnp.inf, smallest)
