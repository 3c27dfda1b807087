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
    seen: Sightings,
    used: ByPoint,
    at: CameraUnknowns,
) -> ByPoint:
    """Test values of all points seen [views, points], in pixels; NaN where there is none.

    **Arguments:** `seen`: the points of the included views; `used` [views, points]: 1 for
    those the camera `at` was adjusted from, 0 for those that were removed.
    """
    columns_x, columns_y = design(model, free, seen, at)
    weighted = [[used * column for column in columns] for columns in (columns_x, columns_y)]
    factor = factorise(gram(*weighted), seen.views, 0.0)

    def test(columns: list[ByPoint]) -> ByPoint:
        h = _leverage(factor, columns[:-1])
        redundancy = jnp.where(used > 0, 1 - h, 1 + h)
        # A point of less redundancy is controlled by no other: far above rounding, far below any
        # redundancy number that serves a test.
        known = (seen.weight > 0) & (redundancy > 1e-6)
        value = jnp.abs(columns[-1]) / jnp.sqrt(jnp.where(known, redundancy, 1.0))
        return jnp.where(known, value, jnp.nan)

    return jnp.fmax(test(columns_x), test(columns_y))


def _leverage(factor: CameraFactor, row: list[ByPoint]) -> ByPoint:
    """a·Q·aᵀ of rows given as columns [views, points]."""
    wide = lambda values: [value[:, None] for value in values]
    L = [wide(elements) for elements in factor.pose]
    scaled = [s * a for s, a in zip(wide(factor.scale.T), row[:POSE])]
    of_pose = forward(L, scaled)
    rest = [
        a - sum(o * e[:, i, None] for o, e in zip(of_pose, factor.eliminated))
        for i, a in enumerate(row[POSE:])
    ]
    rest = jnp.stack([s * a for s, a in zip(factor.interior_scale, rest)])
    flat = rest.reshape(len(rest), -1)
    through = jax.scipy.linalg.solve_triangular(factor.interior, flat, lower=True)
    return sum(o * o for o in of_pose) + (through**2).sum(0).reshape(rest.shape[1:])
