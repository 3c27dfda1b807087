"""`division`: radial distortion as a division.

    [X, Y, Z] = [m, 1 + k·ρ²],  m = [(u − cx)/fx, (v − cy)/fy], ρ² = |m|²

and back, with [X, Y, Z] = [r, −s, −q]:

    u = cx + fx·2X/N,  v = cy + fy·2Y/N,  N = Z + √(Z² − 4·k·(X² + Y²))

For k < 0, a barrel, rays beyond 90° lie outside ρ² = −1/k; only straight backwards has none. For
k > 0 the image ends at ρ² = 1/k, where it turns back: NaN beyond, as for rays without an image.

Units: fx, fy, cx, cy in pixels, (0, 0) the centre of the upper-left pixel, u right, v down; k
without unit.

Source: Fitzgibbon (2001), Simultaneous linear estimation of multiple view geometry and lens
distortion, CVPR; the form and sign of COLMAP's DIVISION.
"""

import jax.numpy as jnp

from jaxbundle.cameras.model import CameraModel
from jaxbundle.cameras.scalars import Pair, Parameters, Scalar, Triple


def project(p: Parameters, r: Scalar, s: Scalar, q: Scalar) -> Pair:
    """The pixel of a ray: the formula of `division`."""
    fx, fy, cx, cy, k = p
    X, Y, Z = r, -s, -q
    N = Z + jnp.sqrt(Z * Z - 4 * k * (X * X + Y * Y))
    # The root with + is the branch through the axis.
    N = jnp.where(N > 0, N, jnp.nan)
    return cx + 2 * fx * X / N, cy + 2 * fy * Y / N


def unproject(p: Parameters, u: Scalar, v: Scalar) -> Triple:
    """The ray of a pixel."""
    fx, fy, cx, cy, k = p
    X, Y = (u - cx) / fx, (v - cy) / fy
    square = k * (X * X + Y * Y)
    return X, -Y, -jnp.where(square < 1, 1 + square, jnp.nan)


DIVISION = CameraModel(
    "division",
    ("fx", "fy", "cx", "cy", "k"),
    project=project,
    unproject=unproject,
    unit="px",
    image="equidistant",
)
