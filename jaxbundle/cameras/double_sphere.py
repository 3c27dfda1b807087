"""`double-sphere`: a projection on two unit spheres, ξ apart, and then on a plane.

    d1 = √(X² + Y² + Z²),  d2 = √(X² + Y² + (ξ·d1 + Z)²)             [X, Y, Z] = [r, −s, −q]
    N = α·d2 + (1 − α)·(ξ·d1 + Z)
    u = cx + fx·X/N,  v = cy + fy·Y/N

and back, with m = [(u − cx)/fx, (v − cy)/fy], ρ² = |m|²:

    mz = (1 − α²·ρ²)/(α·√(1 − (2α − 1)·ρ²) + 1 − α)
    [X, Y, Z] = (mz·ξ + √(mz² + (1 − ξ²)·ρ²))/(mz² + ρ²)·[m, mz] − [0, 0, ξ]

On the axis the image has the scale fx/(1 + ξ). ξ = 0 is `eucm` with β = 1.

Range: Z > −w2·d1, w2 = (w1 + ξ)/√(2·w1·ξ + ξ² + 1), w1 = α/(1 − α) for α ≤ 1/2, else (1 − α)/α; in
the image (2α − 1)·ρ² < 1 for α > 1/2. Elsewhere NaN.

Units: fx, fy, cx, cy in pixels, (0, 0) the centre of the upper-left pixel, u right, v down; α
between 0 and 1 and ξ > −1 without unit.

Source: Usenko, Demmel and Cremers (2018), The double sphere camera model, eq. 40 to 50.
"""

import jax.numpy as jnp

from jaxbundle.cameras.eucm import reach
from jaxbundle.cameras.model import CameraModel
from jaxbundle.cameras.scalars import Pair, Parameters, Scalar, Triple


def project(p: Parameters, r: Scalar, s: Scalar, q: Scalar) -> Pair:
    """The pixel of a ray: the formula of `double-sphere`."""
    fx, fy, cx, cy, xi, alpha = p
    X, Y, Z = r, -s, -q
    square = X * X + Y * Y
    d1 = jnp.sqrt(square + Z * Z)
    shifted_Z = xi * d1 + Z
    N = alpha * jnp.sqrt(square + shifted_Z * shifted_Z) + (1 - alpha) * shifted_Z
    # As far as the image grows: beyond, two rays share a point.
    w1 = reach(alpha)
    w2 = (w1 + xi) / jnp.sqrt(2 * w1 * xi + xi * xi + 1)
    N = jnp.where(Z > -w2 * d1, N, jnp.nan)
    return cx + fx * X / N, cy + fy * Y / N


def unproject(p: Parameters, u: Scalar, v: Scalar) -> Triple:
    """The ray of a pixel."""
    fx, fy, cx, cy, xi, alpha = p
    X, Y = (u - cx) / fx, (v - cy) / fy
    square = X * X + Y * Y
    root = jnp.sqrt(1 - (2 * alpha - 1) * square)
    mz = (1 - alpha * alpha * square) / (alpha * root + 1 - alpha)
    k = (mz * xi + jnp.sqrt(mz * mz + (1 - xi * xi) * square)) / (mz * mz + square)
    return k * X, -k * Y, -(k * mz - xi)


DOUBLE_SPHERE = CameraModel(
    "double-sphere",
    ("fx", "fy", "cx", "cy", "xi", "alpha"),
    project=project,
    unproject=unproject,
    unit="px",
    image="equidistant",
    magnification=lambda p: 1 / (1 + p[4]),
    defaults={"alpha": 0.5},
    ranges={"xi": (-0.999, float("inf")), "alpha": (0.0, 1.0)},
)
