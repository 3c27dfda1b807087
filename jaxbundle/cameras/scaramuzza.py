"""`scaramuzza`: the omnidirectional camera whose rays are a polynomial of the image radius.

    [u − cx, v − cy] = [[c, d], [e, 1]]·[x', y'],        ρ = √(x'² + y'²)
    [X, Y, Z] = [x', y', a0 + a2·ρ² + a3·ρ³ + a4·ρ⁴]                 [r, s, q] = [X, −Y, −Z]

The image of a ray is found by the implicit function.

Range: as far as the angle grows with ρ, a0 − a2·ρ² − 2·a3·ρ³ − 3·a4·ρ⁴ > 0; elsewhere NaN. With
a3 = a4 = 0 and a square, straight sensor it is `division`, k = a0·a2; a0 alone the perspective
image.

Units: a0, cx, cy in pixels, (0, 0) the centre of the upper-left pixel, u right, v down; a_i in
px^(1−i); c, d, e without unit. A turn about the axis, which e and d together are, cannot be
separated from that of every photograph: e is not estimated unless asked for. The
authors' toolbox has the opposite sign of all a_i (their z points backwards), rows before columns
and 1 for the first pixel.

Source: Scaramuzza, Martinelli and Siegwart (2006), A flexible technique for accurate
omnidirectional camera calibration and structure from motion, ICVS, eq. 2, 3 and 6.
"""

import jax.numpy as jnp

from jaxbundle.cameras.model import CameraModel
from jaxbundle.cameras.radial import SAMPLES
from jaxbundle.cameras.scalars import Pair, Parameters, Scalar, Triple


def unproject(p: Parameters, u: Scalar, v: Scalar) -> Triple:
    """The ray of a pixel: the formula of `scaramuzza`."""
    a0, _, _, a2, a3, a4, _, _, _ = p
    x, y = _straight(p, u, v)
    r2 = x * x + y * y
    # √ has no derivative at 0; ρ³ has
    rho = jnp.where(r2 > 0, jnp.sqrt(jnp.where(r2 > 0, r2, 1.0)), 0.0)
    Z = a0 + r2 * (a2 + rho * (a3 + rho * a4))
    # The angle grows while Z − ρ·Z' > 0, at samples as in `radial.is_increasing`.
    growing = jnp.ones_like(r2, bool)
    for i in range(1, SAMPLES + 1):
        t = rho * (i / SAMPLES)
        growing &= a0 - t * t * (a2 + t * (2 * a3 + t * 3 * a4)) > 0
    return x, -y, -jnp.where(growing, Z, jnp.nan)


def _straight(p: Parameters, u: Scalar, v: Scalar) -> Pair:
    """[x', y']: from the principal point, on a square and straight sensor."""
    _, cx, cy, _, _, _, c, d, e = p
    x, y, det = u - cx, v - cy, c - d * e
    return (x - d * y) / det, (c * y - e * x) / det


SCARAMUZZA = CameraModel(
    "scaramuzza",
    ("a0", "cx", "cy", "a2", "a3", "a4", "c", "d", "e"),
    unproject=unproject,
    unit="px",
    image="equidistant",
    start=lambda p, X, Y: (X + p[1], Y + p[2]),
    iterations=14,
    principal_distance=("a0",),
    defaults={"c": 1.0},
    free=("a0", "cx", "cy", "a2", "a3", "a4", "c", "d"),
)
