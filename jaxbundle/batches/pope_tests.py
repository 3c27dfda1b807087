"""Test values of the image points of one camera of a batch, as data snooping needs them.

    |v|/√(1 − h)    an included point, 1 − h its redundancy number
    |v|/√(1 + h)    an excluded one: its predicted residual

with the leverage h = a·Q·aᵀ, for the rows a = [aₑ aᵢ] of x and of y, the larger of the two. With
the factor of the normal equations, N = L·Lᵀ in the order views, interior orientation,
h = |L⁻¹·aᵀ|².
"""

import jax
import jax.numpy as jnp

from jaxbundle.batches.normal import (
    POSE,
    ByPoint,
    CameraFactor,
    CameraUnknowns,
    Sightings,
    design,
    factorise,
    gram,
)
from jaxbundle.batches.small_cholesky import forward
from jaxbundle.cameras import CameraModel


def point_tests(
    model: CameraModel,
    free: tuple[int, ...],
    sightings: Sightings,
    is_used: ByPoint,
    unknowns: CameraUnknowns,
) -> ByPoint:
    """Test values of all points seen [views, points], in pixels; NaN where there is none.

    **Arguments:** `sightings`: the points of the included views; `is_used` [views, points]: 1 for
    those the camera `unknowns` was adjusted from, 0 for those that were removed.
    """
    columns_x, columns_y = design(model, free, sightings, unknowns)
    weighted = [[is_used * column for column in columns] for columns in (columns_x, columns_y)]
    factor = factorise(gram(*weighted), sightings.views, 0.0)

    def test(columns: list[ByPoint]) -> ByPoint:
        h = _leverage(factor, columns[:-1])
        redundancy = jnp.where(is_used > 0, 1 - h, 1 + h)
        # A point of less redundancy is controlled by no other: far above rounding, far below any
        # redundancy number that serves a test.
        is_known = (sightings.weight > 0) & (redundancy > 1e-6)
        value = jnp.abs(columns[-1]) / jnp.sqrt(jnp.where(is_known, redundancy, 1.0))
        return jnp.where(is_known, value, jnp.nan)

    return jnp.fmax(test(columns_x), test(columns_y))


def _leverage(factor: CameraFactor, row: list[ByPoint]) -> ByPoint:
    """a·Q·aᵀ of rows given as columns [views, points]."""
    wide = lambda values: [value[:, None] for value in values]
    L = [wide(elements) for elements in factor.pose]
    scaled = [s * a for s, a in zip(wide(factor.scale.T), row[:POSE])]
    of_pose = forward(L, scaled)
    interior_rows = [
        a - sum(o * e[:, i, None] for o, e in zip(of_pose, factor.eliminated))
        for i, a in enumerate(row[POSE:])
    ]
    interior_rows = jnp.stack([s * a for s, a in zip(factor.interior_scale, interior_rows)])
    flat = interior_rows.reshape(len(interior_rows), -1)
    through = jax.scipy.linalg.solve_triangular(factor.interior, flat, lower=True)
    return sum(o * o for o in of_pose) + (through**2).sum(0).reshape(interior_rows.shape[1:])
