"""`opencv`: OpenCV's camera with up to twelve distortion coefficients, evaluated at the projection.

    x' = X/Z,  y' = Y/Z,  r² = x'² + y'²                             [X, Y, Z] = [r, −s, −q]
    k   = (1 + k1·r² + k2·r⁴ + k3·r⁶) / (1 + k4·r² + k5·r⁴ + k6·r⁶)
    x'' = x'·k + 2·p1·x'·y' + p2·(r² + 2x'²) + s1·r² + s2·r⁴
    y'' = y'·k + p1·(r² + 2y'²) + 2·p2·x'·y' + s3·r² + s4·r⁴
    u = fx·x'' + cx,  v = fy·y'' + cy

The usual variants are a choice of what is free: 4 coefficients k1, k2, p1, p2; 5 with k3; 8
("rational") with k4, k5, k6; 12 ("thin prism") with s1 to s4. OpenCV's order of coefficients is
this one. The tilted sensor (τx, τy) is not offered.

Units: fx, fy, cx, cy in pixels, (0, 0) the centre of the upper-left pixel, u right, v down; the
coefficients without unit. Ideal coordinates are pixels from the principal point, (fx·x', fy·y').

Source: OpenCV 4 documentation, calib3d, "Camera Calibration and 3D Reconstruction".
"""

from jaxbundle.cameras.model import CameraModel
from jaxbundle.cameras.scalars import Pair, Parameters, Scalar


def distort(p: Parameters, xi: Scalar, yi: Scalar) -> Pair:
    """Ideal to measured pixel coordinates: the formula of `opencv`."""
    fx, fy, cx, cy, k1, k2, p1, p2, k3, k4, k5, k6, s1, s2, s3, s4 = p
    x, y = xi / fx, yi / fy
    r2 = x * x + y * y
    radial = (1 + r2 * (k1 + r2 * (k2 + r2 * k3))) / (1 + r2 * (k4 + r2 * (k5 + r2 * k6)))
    xd = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x) + r2 * (s1 + r2 * s2)
    yd = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y + r2 * (s3 + r2 * s4)
    return fx * xd + cx, fy * yd + cy


def reduce(p: Parameters, u: Scalar, v: Scalar) -> Pair:
    """Pixel coordinates relative to the principal point."""
    return u - p[2], v - p[3]


OPENCV = CameraModel(
    "opencv",
    (
        "fx",
        "fy",
        "cx",
        "cy",
        "k1",
        "k2",
        "p1",
        "p2",
        "k3",
        "k4",
        "k5",
        "k6",
        "s1",
        "s2",
        "s3",
        "s4",
    ),
    distort=distort,
    unit="px",
    start=reduce,
    iterations=8,
    free=("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3"),
)
