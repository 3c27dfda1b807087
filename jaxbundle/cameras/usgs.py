"""`usgs`: the model of the USGS Report of Calibration (SMAC adjustment).

    Δx = x·k + (1 + P3·r² + P4·r⁴)·(P1·(r² + 2x²) + 2·P2·x·y)
    Δy = y·k + (1 + P3·r² + P4·r⁴)·(P2·(r² + 2y²) + 2·P1·x·y)
    k  = K0 + K1·r² + K2·r⁴ + K3·r⁶ + K4·r⁸                                    r² = x² + y²
    xi = x + Δx,  yi = y + Δy

x, y are measured from the calibrated principal point, the point of symmetry (x0, y0). Beware the
numbering: K0 is the linear term. The report's table shows the DISTORTION, −(K0·r + K1·r³ + …),
while its coefficients are those of the CORRECTION, as here.

Units: mm; K_i in mm^−2i, P1 and P2 in 1/mm, P3 in mm⁻², P4 in mm⁻⁴.

Source: Light (1992), The new camera calibration system at the U.S. Geological Survey, PE&RS 58(2);
the figures of a Report of Calibration of 16 June 2005 follow.
"""

from jaxbundle.cameras import brown
from jaxbundle.cameras.model import CameraModel
from jaxbundle.cameras.scalars import Pair, Parameters, Scalar


def polynomial(p: Parameters, x: Scalar, y: Scalar) -> Pair:
    """(Δx, Δy) in mm at (x, y), in mm from the principal point."""
    _, _, _, K0, K1, K2, K3, K4, P1, P2, P3, P4 = p
    r2 = x * x + y * y
    radial = K0 + r2 * (K1 + r2 * (K2 + r2 * (K3 + r2 * K4)))
    profile = 1 + r2 * (P3 + r2 * P4)
    dx = x * radial + profile * (P1 * (r2 + 2 * x * x) + 2 * P2 * x * y)
    dy = y * radial + profile * (P2 * (r2 + 2 * y * y) + 2 * P1 * x * y)
    return dx, dy


def correct(p: Parameters, x: Scalar, y: Scalar) -> Pair:
    """Measured to ideal coordinates, mm: the formula of `usgs`."""
    x, y = brown.reduce(p, x, y)
    dx, dy = polynomial(p, x, y)
    return x + dx, y + dy


USGS = CameraModel(
    "usgs",
    ("c", "x0", "y0", "K0", "K1", "K2", "K3", "K4", "P1", "P2", "P3", "P4"),
    correct=correct,
    start=brown.unreduce,
    free=("c", "x0", "y0", "K1", "K2", "K3", "P1", "P2"),
)
