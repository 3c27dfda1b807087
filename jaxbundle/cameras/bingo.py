"""`bingo`: radial distortion by the additional parameters 25 and 26 of the BINGO program.

    ρ = R·F/100                                                       R = √(x² + y²)
    dr = p25·S25·ρ·(1 − ρ²) + p26·S26·ρ·(1 − ρ²)·(ρ − 0.4)
    xi = x·(1 − dr/R) − x0,  yi = y·(1 − dr/R) − y0

x, y are measured from the image ORIGIN, not from the principal point: dr is the distortion of the
measurement, so it is subtracted. F, the format factor, puts the zero of dr at R = 100/F. It is a
convention, never an unknown. dr/R is written without the division, finite at R = 0.

Units: the image unit of the files (in the listings named below, 1 unit = 10 px); p25 and p26 in
the same unit, listed by the program in 1/1000 of it.

Source: the eight radial tables of the BINGO 5.5 listings printed by Repanšek (2009, Kalibracija
videokamere za uporabo v mobilnem kartirnem sistemu), all of which the formula reproduces; the
normalising constants S25 and S26 were fitted to them. The sign follows from the listed correlations
of the parameters, c with 25 −69 %, 26 with 25 −13 %: a simulation of that network gives −71 and −13
with this sign, +73 and −48 with the other. Parameter 17, which occurs in the listings, is not
published there and not offered here.
"""

import jax.numpy as jnp

from jaxbundle.cameras import brown
from jaxbundle.cameras.model import CameraModel
from jaxbundle.cameras.scalars import Pair, Parameters, Scalar

# Not published: fitted by least squares to the eight printed tables (see the module).
S25 = 0.3737850724543663
S26 = 0.304789700626975


def relative_distortion(p: Parameters, R: Scalar) -> Scalar:
    """dr/R, without unit, at the radius R from the image origin, in the image unit."""
    _, _, _, p25, p26, F = p
    # R·F/100 = 1: the zero of dr that the format factor places in the image.
    rho = R * F / 100
    return F / 100 * (1 - rho**2) * (p25 * S25 + p26 * S26 * (rho - 0.4))


def correct(p: Parameters, x: Scalar, y: Scalar) -> Pair:
    """Measured to ideal coordinates, in the image unit: the formula of `bingo`."""
    factor = 1 - relative_distortion(p, _radius(x, y))
    return brown.reduce(p, x * factor, y * factor)


def _radius(x: Scalar, y: Scalar) -> Scalar:
    # √ has no derivative at 0; what is multiplied by x or y there needs none
    square = x * x + y * y
    is_positive = square > 0
    return jnp.where(is_positive, jnp.sqrt(jnp.where(is_positive, square, 1.0)), 0.0)


BINGO = CameraModel(
    "bingo",
    ("c", "x0", "y0", "p25", "p26", "format_factor"),
    correct=correct,
    start=brown.unreduce,
    defaults={"format_factor": 1.0},
    never_free=("format_factor",),
)
