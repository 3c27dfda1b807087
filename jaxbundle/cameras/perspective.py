"""The perspective image of a ray: the collinearity equations after the rotation.

    xi = −c·r/q,  yi = −c·s/q                       y up
    xi = fx·X/Z,  yi = fy·Y/Z                       v down, [X, Y, Z] = [r, −s, −q]

Source: Kraus (2007), Photogrammetry, section 2.1.
"""

from collections.abc import Sequence

import jax.numpy as jnp

from jaxbundle.cameras.scalars import OfRay, Pair, Parameters, Scalar, ToRay, Triple


def perspective(columns: Sequence[int], up: bool) -> tuple[OfRay, ToRay]:
    """The ideal image of a ray, and the ray of an ideal image.

    **Arguments:** `columns` of the principal distance among the parameters, or of the two, along
    and across; `up`: whether y points up.
    """
    column_x, column_y = columns[0], columns[-1]

    def ideal(p: Parameters, r: Scalar, s: Scalar, q: Scalar) -> Pair:
        return -p[column_x] * r / q, -p[column_y] * s / q if up else p[column_y] * s / q

    def ray(p: Parameters, xi: Scalar, yi: Scalar) -> Triple:
        if column_x == column_y:
            X, Y, Z = xi, yi, p[column_x]
        else:
            X, Y, Z = xi / p[column_x], yi / p[column_y], 1
        length = jnp.sqrt(X * X + Y * Y + Z * Z)
        return X / length, Y / length if up else -Y / length, -Z / length

    return ideal, ray
