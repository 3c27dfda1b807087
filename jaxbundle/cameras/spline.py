"""`spline-NXxNY-FOV`: a rich model, a grid of cubic B-splines over stereographic coordinates.

    [a, b] = 2·tan(θ/2)·[cos ψ, sin ψ]       θ the angle to the optical axis, ψ the azimuth
    u = cx + fx·(a + ΣΣ B((a − a_j)/h)·B((b − b_i)/h)·dx_i_j)
    v = cy + fy·(b + ΣΣ B((a − a_j)/h)·B((b − b_i)/h)·dy_i_j)

with knots a_j = (j − (NX − 1)/2)·h and b_i = (i − (NY − 1)/2)·h, i the row from the top, and the
spacing h = 4·tan(FOV/4)/(NX − 3): FOV is the field of view along a row, and one knot is
outside of it on either side. A point depends on 4 × 4 knots only. The inverse is by the implicit
function. Outside the knots' field, |a| ≤ (NX − 3)·h/2 and |b| ≤ (NY − 3)·h/2, NaN.

It can represent any lens, including field curvature and decentred elements, with 2·NX·NY
parameters. fx, fy, cx, cy are conventions: the grid absorbs their effect. Knots without points,
and the rotation of the camera frame, which every pose absorbs, are determined by a weak prior σ of
the knots around the start values: in `calibrate`, the parametric lens of the start.

`spline-12x9-110` has 12 × 9 knots and a field of view of 110°.

Units: fx, fy, cx, cy in pixels, (0, 0) the centre of the upper-left pixel, u right, v down; dx, dy
without unit, about radians.

Source: the splined stereographic model of Kogan's mrcal (its documentation, "Splined stereographic
lens model"), of third order, whose knots and order of parameters these are.
"""

import dataclasses
from collections.abc import Sequence
from functools import lru_cache

import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxbundle.cameras import opencv
from jaxbundle.cameras.cubic_splines import basis
from jaxbundle.cameras.inverse import limit_region
from jaxbundle.cameras.model import CameraModel, LocalFormula
from jaxbundle.cameras.scalars import Pair, Parameters, Scalar

CORE = ("fx", "fy", "cx", "cy")


@dataclasses.dataclass(frozen=True)
class _Grid:
    """The knots of a model; `per_unit`: knots in a unit of the stereographic image."""

    columns: int
    rows: int
    per_unit: float

    def in_knots(self, p: Parameters, xi: Scalar, yi: Scalar) -> Pair:
        """Column and row of an ideal point, the first knot at (0, 0)."""
        s = xi / p[0] * self.per_unit + (self.columns - 1) / 2
        return s, yi / p[1] * self.per_unit + (self.rows - 1) / 2

    def inside(self, p: Parameters, xi: Scalar, yi: Scalar) -> Scalar:
        """Whether a point has 4 × 4 knots."""
        s, t = self.in_knots(p, xi, yi)
        return (s >= 1) & (s <= self.columns - 2) & (t >= 1) & (t <= self.rows - 2)

    def distort(self, p: Parameters, xi: Scalar, yi: Scalar) -> Pair:
        """Ideal to measured coordinates, by all knots: most of the basis is 0."""
        grid = jnp.stack(jnp.broadcast_arrays(*p[4:]), -1)
        grid = grid.reshape(*grid.shape[:-1], self.rows, self.columns, 2)
        return self.bend(p, grid, self.in_knots(p, xi, yi), xi, yi)

    def bend(self, p: Parameters, grid: Array, at: Pair, xi: Scalar, yi: Scalar) -> Pair:
        """By a grid of knots [..., rows, columns, 2] of which the first is at (0, 0)."""
        basis_across, basis_down = basis(at[0], 0, grid.shape[-2]), basis(at[1], 0, grid.shape[-3])
        da, db = jnp.moveaxis(
            jnp.einsum("...i,...ijk,...j->...k", basis_down, grid, basis_across), -1, 0
        )
        return p[2] + xi + p[0] * da, p[3] + yi + p[1] * db

    def seen(self, p: Parameters, xi: Scalar, yi: Scalar) -> tuple[Array, ...]:
        """The parameters of the 4 × 4 knots on which a point depends."""
        s, t = self.in_knots(p, xi, yi)
        first_knot = lambda x, n: jnp.clip(jnp.floor(x), 1, n - 3).astype(int) - 1
        j, i = first_knot(s, self.columns), first_knot(t, self.rows)
        return tuple(
            len(CORE) + 2 * ((i + row) * self.columns + j + column) + k
            for row in range(4)
            for column in range(4)
            for k in range(2)
        )

    def distort_by_seen(
        self, p: Parameters, which: Sequence[Array], knots: Sequence[Scalar], xi: Scalar, yi: Scalar
    ) -> Pair:
        """The same as `distort`, by the values of the knots that are seen."""
        # The first of them has the number 2·(row·columns + column) after the core.
        first_number = (which[0] - len(CORE)) // 2
        s, t = self.in_knots(p, xi, yi)
        grid = jnp.stack(knots, -1)
        grid = grid.reshape(*grid.shape[:-1], 4, 4, 2)
        at = s - first_number % self.columns, t - first_number // self.columns
        return self.bend(p, grid, at, xi, yi)


@lru_cache(maxsize=64)
def spline(columns: int, rows: int, degrees: float) -> CameraModel:
    """The model with a grid of columns × rows knots over a field of view.

    **Raises:** `ValueError` for a grid that is not 4 to 40 knots either way, a field of view that
    is not in 0° to 350°.
    """
    # A point has 4 × 4 knots; 40 × 40 are 3200 parameters, 80 MB of normal equations.
    fewest, most = 4, 40
    if not (fewest <= min(columns, rows) and max(columns, rows) <= most and 0 < degrees <= 350):
        raise ValueError(
            f"a spline of {columns} × {rows} knots over {degrees:g}°: expected {fewest} to {most} "
            "knots either way and a field of view up to 350°, such as spline-12x9-110"
        )
    per_unit = float((columns - 3) / (4 * np.tan(np.radians(degrees) / 4)))
    grid = _Grid(columns, rows, per_unit)
    distort, inverse = limit_region(grid.distort, grid.inside, opencv.reduce, 12)
    knots = tuple(f"d{k}_{i}_{j}" for i in range(rows) for j in range(columns) for k in "xy")
    return CameraModel(
        f"spline-{columns}x{rows}-{degrees:g}",
        (*CORE, *knots),
        distort=distort,
        inverse=inverse,
        unit="px",
        image="stereographic",
        free=knots,
        never_free=CORE,
        # σ of a knot about the parametric lens: some per cent of the radius, tens of pixels. Knots
        # with points are known a hundred times better, so that it moves none of them.
        prior=dict.fromkeys(knots, 0.02),
        local=LocalFormula(32, grid.seen, grid.distort_by_seen),
    )
