"""`kannala-brandt`: the fisheye camera of Kannala and Brandt (2006), as in OpenCV's fisheye module.

    θ = angle between the ray and the optical axis,  ψ = its azimuth in the image
    θd = θ·(1 + k1·θ² + k2·θ⁴ + k3·θ⁶ + k4·θ⁸)
    u = fx·θd·cos ψ + cx,  v = fy·θd·sin ψ + cy

The ideal image is the equidistant one (`fisheye_images.py`), (fx·θ·cos ψ, fy·θ·sin ψ) from the
principal point, and the distortion a polynomial in it, smooth everywhere.

Units: fx, fy, cx, cy in pixels, (0, 0) the centre of the upper-left pixel, u right, v down; the
coefficients without unit, θ in radians.

Source: Kannala and Brandt (2006), IEEE PAMI 28(8), eq. 6; OpenCV 4 documentation, fisheye.
"""

from jaxbundle.cameras import opencv
from jaxbundle.cameras.model import CameraModel
from jaxbundle.cameras.scalars import Pair, Parameters, Scalar


def distort(p: Parameters, xi: Scalar, yi: Scalar) -> Pair:
    """Ideal to measured pixel coordinates: the formula of `kannala-brandt`."""
    fx, fy, cx, cy, k1, k2, k3, k4 = p
    X, Y = xi / fx, yi / fy
    t2 = X * X + Y * Y
    factor = 1 + t2 * (k1 + t2 * (k2 + t2 * (k3 + t2 * k4)))
    return xi * factor + cx, yi * factor + cy


KANNALA_BRANDT = CameraModel(
    "kannala-brandt",
    ("fx", "fy", "cx", "cy", "k1", "k2", "k3", "k4"),
    distort=distort,
    unit="px",
    image="equidistant",
    start=opencv.reduce,
    iterations=12,
)
