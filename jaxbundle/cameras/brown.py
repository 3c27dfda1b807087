"""`brown` and `brown-projected`: radial, decentring and affine distortion (Brown 1971).

    Δx = x·ΣK_i·(r^2i − r0^2i) + P1·(r² + 2x²) + 2·P2·x·y + b1·x + b2·y
    Δy = y·ΣK_i·(r^2i − r0^2i) + P2·(r² + 2y²) + 2·P1·x·y             r² = x² + y², i = 1, 2, 3

with x, y relative to the principal point. `r0` is the radius where the radial distortion is
balanced to zero; 0, the default, gives Brown's unbalanced polynomial. It is a convention that goes
with c, never an unknown.

- `brown`: (Δx, Δy) is a CORRECTION, taken at the measured point: xi = x − x0 + Δx(x − x0, y − y0).
- `brown-projected`: (Δx, Δy) is the DISTORTION, taken at the projected point:
  x = x0 + xi + Δx(xi, yi). The convention of AICON 3D Studio.

Units: mm; c, x0, y0, r0 in mm, K_i in mm^−2i, P1 and P2 in 1/mm, b1 and b2 without unit. The two
models have opposite signs for the same lens.

Source: Brown (1971), Close-Range Camera Calibration, Photogrammetric Engineering 37(8); the
balanced form: Luhmann, Robson, Kyle and Boehm (2014), Close-Range Photogrammetry and 3D Imaging.
"""

from jaxbundle.cameras.model import CameraModel
from jaxbundle.cameras.scalars import Pair, Parameters, Scalar

PARAMETERS = ("c", "x0", "y0", "K1", "K2", "K3", "P1", "P2", "b1", "b2", "r0")


def polynomial(p: Parameters, x: Scalar, y: Scalar) -> Pair:
    """(Δx, Δy) in mm at (x, y), in mm from the principal point."""
    _, _, _, K1, K2, K3, P1, P2, b1, b2, r0 = p
    r2, z2 = x * x + y * y, r0 * r0
    radial = K1 * (r2 - z2) + K2 * (r2**2 - z2**2) + K3 * (r2**3 - z2**3)
    dx = x * radial + P1 * (r2 + 2 * x * x) + 2 * P2 * x * y + b1 * x + b2 * y
    dy = y * radial + P2 * (r2 + 2 * y * y) + 2 * P1 * x * y
    return dx, dy


def reduce(p: Parameters, x: Scalar, y: Scalar) -> Pair:
    """Coordinates relative to the principal point."""
    return x - p[1], y - p[2]


def unreduce(p: Parameters, x: Scalar, y: Scalar) -> Pair:
    """Coordinates relative to the image origin."""
    return x + p[1], y + p[2]


def correct(p: Parameters, x: Scalar, y: Scalar) -> Pair:
    """Measured to ideal coordinates, mm: the formula of `brown`."""
    x, y = reduce(p, x, y)
    dx, dy = polynomial(p, x, y)
    return x + dx, y + dy


def distort(p: Parameters, xi: Scalar, yi: Scalar) -> Pair:
    """Ideal to measured coordinates, mm: the formula of `brown-projected`."""
    dx, dy = polynomial(p, xi, yi)
    return unreduce(p, xi + dx, yi + dy)


BROWN = CameraModel(
    "brown", PARAMETERS, correct=correct, start=unreduce, free=PARAMETERS[:8], never_free=("r0",)
)

BROWN_PROJECTED = CameraModel(
    "brown-projected",
    PARAMETERS,
    distort=distort,
    start=reduce,
    free=PARAMETERS[:8],
    never_free=("r0",),
)
