"""`mei`: the omnidirectional camera, a projection on the unit sphere, a plane, and a distortion.

    m = [X, Y]/(Z + ξ·R),  R = |X, Y, Z|                             [X, Y, Z] = [r, −s, −q]
    mx' = mx·(1 + k1·ρ² + k2·ρ⁴) + 2·p1·mx·my + p2·(ρ² + 2mx²)       ρ² = |m|²
    my' = my·(1 + k1·ρ² + k2·ρ⁴) + 2·p2·mx·my + p1·(ρ² + 2my²)
    u = cx + fx·mx',  v = cy + fy·my'

and back: the distortion by the implicit function, then

    [X, Y, Z] = η·[m, 1] − [0, 0, ξ],  η = (ξ + √(1 + (1 − ξ²)·ρ²))/(1 + ρ²)

ξ = 0 is the perspective image with OpenCV's distortion, ξ = 1 the stereographic one (a parabolic
mirror). On the axis the image has the scale fx/(1 + ξ).

Range: Z > −w·R, w the smaller of ξ and 1/ξ, and as far as the distortion rises. Elsewhere NaN.

Units: fx, fy (the generalised focal lengths γ of the source), cx, cy in pixels, (0, 0) the centre
of the upper-left pixel, u right, v down; the others without unit. OpenCV's `omnidir` is this model
with a skew, which is not offered.

Source: Mei and Rives (2007), Single view point omnidirectional camera calibration from planar
grids, ICRA.
"""

import jax.numpy as jnp

from jaxbundle.cameras.inverse import implicit_inverse
from jaxbundle.cameras.model import CameraModel
from jaxbundle.cameras.radial import is_increasing, radial
from jaxbundle.cameras.scalars import Pair, Parameters, Scalar, Triple


def distort(p: Parameters, x: Scalar, y: Scalar) -> Pair:
    """m' of m."""
    _, _, _, _, _, k1, k2, p1, p2 = p
    r2 = x * x + y * y
    k = radial((k1, k2), r2)
    xd = x * k + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
    yd = y * k + 2 * p2 * x * y + p1 * (r2 + 2 * y * y)
    return xd, yd


_undistort = implicit_inverse(distort, lambda _p, X, Y: (X, Y), 10)


def project(p: Parameters, r: Scalar, s: Scalar, q: Scalar) -> Pair:
    """The pixel of a ray: the formula of `mei`."""
    fx, fy, cx, cy, xi, k1, k2, _, _ = p
    X, Y, Z = r, -s, -q
    R = jnp.sqrt(X * X + Y * Y + Z * Z)
    # w = min(ξ, 1/ξ), without dividing by 0
    front = Z * jnp.maximum(xi, 1.0) > -jnp.minimum(xi, 1.0) * R
    N = jnp.where(front, Z + xi * R, jnp.nan)
    x, y = X / N, Y / N
    xd, yd = distort(p, x, y)
    # Beyond the turn a ray has an image that belongs to another ray.
    is_inside = is_increasing((k1, k2), x * x + y * y)
    return cx + fx * jnp.where(is_inside, xd, jnp.nan), cy + fy * jnp.where(is_inside, yd, jnp.nan)


def unproject(p: Parameters, u: Scalar, v: Scalar) -> Triple:
    """The ray of a pixel."""
    fx, fy, cx, cy, xi, *_ = p
    x, y = _undistort(p, (u - cx) / fx, (v - cy) / fy)
    square = x * x + y * y
    eta = (xi + jnp.sqrt(1 + (1 - xi * xi) * square)) / (1 + square)
    return eta * x, -eta * y, -(eta - xi)


MEI = CameraModel(
    "mei",
    ("fx", "fy", "cx", "cy", "xi", "k1", "k2", "p1", "p2"),
    project=project,
    unproject=unproject,
    unit="px",
    image="equidistant",
    magnification=lambda p: 1 / (1 + p[4]),
    defaults={"xi": 1.0},
    ranges={"xi": (0.0, float("inf"))},
)
