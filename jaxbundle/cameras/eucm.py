"""`eucm`: the enhanced unified camera, a projection on an ellipsoid and then on a plane.

    d = √(β·(X² + Y²) + Z²)                                          [X, Y, Z] = [r, −s, −q]
    u = cx + fx·X/(α·d + (1 − α)·Z),  v = cy + fy·Y/(α·d + (1 − α)·Z)

and back, with m = [(u − cx)/fx, (v − cy)/fy], ρ² = |m|²:

    [X, Y, Z] = [m, (1 − β·α²·ρ²)/(α·√(1 − (2α − 1)·β·ρ²) + 1 − α)]

α = 0 is the perspective image; α = 1/2 with β = 1 the stereographic one.

Range: Z > −w·d, w = α/(1 − α) for α ≤ 1/2, else (1 − α)/α; what is behind has no image. In the
image (2α − 1)·β·ρ² < 1 for α > 1/2. Elsewhere NaN.

Units: fx, fy, cx, cy in pixels, (0, 0) the centre of the upper-left pixel, u right, v down; α
between 0 and 1 and β > 0 without unit.

Source: Khomutenko, Garcia and Martinet (2016), An enhanced unified camera model, IEEE Robotics and
Automation Letters 1(1); the range: Usenko, Demmel and Cremers (2018), The double sphere camera
model, eq. 19 to 22.
"""

import jax.numpy as jnp

from jaxbundle.cameras.model import CameraModel
from jaxbundle.cameras.scalars import Pair, Parameters, Scalar, Triple


def project(p: Parameters, r: Scalar, s: Scalar, q: Scalar) -> Pair:
    """The pixel of a ray: the formula of `eucm`."""
    fx, fy, cx, cy, alpha, beta = p
    X, Y, Z = r, -s, -q
    d = jnp.sqrt(beta * (X * X + Y * Y) + Z * Z)
    N = alpha * d + (1 - alpha) * Z
    N = jnp.where(Z > -reach(alpha) * d, N, jnp.nan)
    return cx + fx * X / N, cy + fy * Y / N


def unproject(p: Parameters, u: Scalar, v: Scalar) -> Triple:
    """The ray of a pixel."""
    fx, fy, cx, cy, alpha, beta = p
    X, Y = (u - cx) / fx, (v - cy) / fy
    square = beta * (X * X + Y * Y)
    root = jnp.sqrt(1 - (2 * alpha - 1) * square)
    return X, -Y, -(1 - alpha * alpha * square) / (alpha * root + 1 - alpha)


def reach(alpha: Scalar) -> Scalar:
    """w: minus the cosine of the largest visible angle of a unified camera (for β = 1)."""
    small = jnp.minimum(alpha, 1 - alpha)
    return small / (1 - small)


EUCM = CameraModel(
    "eucm",
    ("fx", "fy", "cx", "cy", "alpha", "beta"),
    project=project,
    unproject=unproject,
    unit="px",
    image="equidistant",
    defaults={"alpha": 0.5, "beta": 1.0},
    ranges={"alpha": (0.0, 1.0), "beta": (1e-6, float("inf"))},
)
