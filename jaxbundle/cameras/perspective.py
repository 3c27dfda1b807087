"""The perspective image of a ray: the collinearity equations after the rotation.

    xi = −c·r/q,  yi = −c·s/q                       mm, y up
    xi = fx·X/Z,  yi = fy·Y/Z                       px, v down, [X, Y, Z] = [r, −s, −q]

Source: Kraus (2007), Photogrammetry, section 2.1.
"""

import jax.numpy as jnp

from .model import Pair, Parameters, Scalar, Triple


def ideal(p: Parameters, r: Scalar, s: Scalar, q: Scalar) -> Pair:
    """Ideal coordinates of a ray, y up; the principal distance is the first parameter."""
    c = p[0]
    return -c * r / q, -c * s / q


def ray(p: Parameters, xi: Scalar, yi: Scalar) -> Triple:
    """The ray of ideal coordinates, y up."""
    c = p[0]
    length = jnp.sqrt(xi * xi + yi * yi + c * c)
    return xi / length, yi / length, -c / length


def ideal_px(p: Parameters, r: Scalar, s: Scalar, q: Scalar) -> Pair:
    """Ideal pixel coordinates of a ray, v down; fx and fy are the first two parameters."""
    fx, fy = p[0], p[1]
    return -fx * r / q, fy * s / q


def ray_px(p: Parameters, xi: Scalar, yi: Scalar) -> Triple:
    """The ray of ideal pixel coordinates, v down."""
    fx, fy = p[0], p[1]
    X, Y = xi / fx, yi / fy
    length = jnp.sqrt(X * X + Y * Y + 1)
    return X / length, -Y / length, -1 / length
