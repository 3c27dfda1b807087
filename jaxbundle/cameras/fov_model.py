"""`fov`: the field-of-view model of a fisheye, with one coefficient.

    ρ = atan(2·tan(ω/2)·tan θ)/ω                    θ the angle to the optical axis, ψ the azimuth
    u = cx + fx·ρ·cos ψ,  v = cy + fy·ρ·sin ψ

and back: tan θ = tan(ω·ρ)/(2·tan(ω/2)). The arc tangent is taken in its quadrant, so that rays
beyond 90° have images too, to 180°, at ω·ρ = π; farther out NaN.

On the axis the image has the scale fx·2·tan(ω/2)/ω.

Units: fx, fy, cx, cy in pixels, (0, 0) the centre of the upper-left pixel, u right, v down; ω in
radians, between 0 and π.

Source: Devernay and Faugeras (2001), Straight lines have to be straight, Machine Vision and
Applications 13(1), eq. 13 and 14; COLMAP's FOV.
"""

import jax.numpy as jnp

from jaxbundle.cameras.fisheye_images import angle_over_sine, cosine, sine_over_angle
from jaxbundle.cameras.model import CameraModel
from jaxbundle.cameras.scalars import Pair, Parameters, Scalar, Triple


def project(p: Parameters, r: Scalar, s: Scalar, q: Scalar) -> Pair:
    """The pixel of a ray: the formula of `fov`."""
    fx, fy, cx, cy, omega = p
    # atan2 keeps the quadrant, so that the image goes on beyond 90°.
    wide = 2 * jnp.tan(omega / 2)
    scale = wide / omega * angle_over_sine(wide * wide * (r * r + s * s), q)
    return cx + fx * scale * r, cy - fy * scale * s


def unproject(p: Parameters, u: Scalar, v: Scalar) -> Triple:
    """The ray of a pixel."""
    fx, fy, cx, cy, omega = p
    X, Y = omega * (u - cx) / fx, omega * (v - cy) / fy
    square = X * X + Y * Y
    # ω·ρ = π is straight backwards.
    square = jnp.where(square < jnp.pi**2, square, jnp.nan)
    scale = sine_over_angle(square)
    return X * scale, -Y * scale, -2 * jnp.tan(omega / 2) * cosine(square)


FOV = CameraModel(
    "fov",
    ("fx", "fy", "cx", "cy", "omega"),
    project=project,
    unproject=unproject,
    unit="px",
    image="equidistant",
    magnification=lambda p: 2 * jnp.tan(p[4] / 2) / p[4],
    defaults={"omega": 0.9},
    ranges={"omega": (1e-6, 3.14159)},
)
