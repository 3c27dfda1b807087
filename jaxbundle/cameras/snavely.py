"""`snavely`: the camera of Bundler and of the BAL data sets ("bundle adjustment in the large").

    [X, Y] = −[r, s]/q,  ρ² = X² + Y²
    [x, y] = f·(1 + k1·ρ² + k2·ρ⁴)·[X, Y]

Units: f in pixels, k1 and k2 without unit. Pixels here are counted from the image centre, with
axes x right and y UP, unlike the other pixel models; there is no principal point.

Source: Snavely, Seitz and Szeliski (2006), Photo Tourism; Agarwal et al. (2010), Bundle Adjustment
in the Large.
"""

from jaxbundle.cameras.model import CameraModel
from jaxbundle.cameras.scalars import Pair, Parameters, Scalar


def distort(p: Parameters, xi: Scalar, yi: Scalar) -> Pair:
    """Ideal to measured coordinates, pixels: the formula of `snavely`."""
    f, k1, k2 = p
    rho2 = (xi * xi + yi * yi) / (f * f)
    factor = 1 + rho2 * (k1 + rho2 * k2)
    return xi * factor, yi * factor


SNAVELY = CameraModel(
    "snavely",
    ("f", "k1", "k2"),
    distort=distort,
    unit="px",
    axes="up",
    start=lambda _p, X, Y: (X, Y),
    iterations=8,
)
