"""Fisheyes with more than a radial distortion: three models with a polynomial in the angle.

    [a, b] = θ·[cos ψ, sin ψ]        θ the angle to the optical axis, ψ the azimuth in the image
    u = cx + fx·a',  v = cy + fy·b'

`thin-prism-fisheye`; `kannala-brandt-tangential` is it without sx1 and sy1; t² = a² + b²:

    a' = a·(1 + k1·t² + k2·t⁴ + k3·t⁶ + k4·t⁸) + 2·p1·a·b + p2·(t² + 2a²) + sx1·t²
    b' = b·(1 + k1·t² + k2·t⁴ + k3·t⁶ + k4·t⁸) + 2·p2·a·b + p1·(t² + 2b²) + sy1·t²

`rad-tan-thin-prism-fisheye`: [g, h] = [a, b]·(1 + k0·t² + … + k5·t¹²), d² = g² + h²,

    a' = g + 2·p1·g·h + p0·(d² + 2g²) + s0·d² + s1·d⁴
    b' = h + 2·p0·g·h + p1·(d² + 2h²) + s2·d² + s3·d⁴

The inverse is by the implicit function. Range: as far as the radial polynomial rises, and to 180°;
elsewhere NaN.

Units: fx, fy, cx, cy in pixels, (0, 0) the centre of the upper-left pixel, u right, v down; the
coefficients without unit, θ in radians.

Source: Kannala and Brandt (2006), IEEE PAMI 28(8), for the angle; Weng, Cohen and Herniou (1992),
IEEE PAMI 14(10), for decentring and thin prism; COLMAP's THIN_PRISM_FISHEYE and
RAD_TAN_THIN_PRISM_FISHEYE (Project Aria's Fisheye624) for the combinations.
"""

from collections.abc import Callable

import jax.numpy as jnp

from jaxbundle.cameras.fisheye_images import equidistant
from jaxbundle.cameras.inverse import implicit_inverse
from jaxbundle.cameras.model import CameraModel
from jaxbundle.cameras.radial import is_increasing, radial
from jaxbundle.cameras.scalars import Formula, Pair, Parameters, Scalar, Triple

CORE = ("fx", "fy", "cx", "cy")
_angle, _ray = equidistant((0, 1), up=False)


def _decentre(x: Scalar, y: Scalar, r2: Scalar, p1: Scalar, p2: Scalar) -> Pair:
    return 2 * p1 * x * y + p2 * (r2 + 2 * x * x), 2 * p2 * x * y + p1 * (r2 + 2 * y * y)


def thin_prism(p: Parameters, a: Scalar, b: Scalar) -> Pair:
    """[a', b'] of `thin-prism-fisheye`."""
    _, _, _, _, k1, k2, p1, p2, k3, k4, sx1, sy1 = p
    t2 = a * a + b * b
    k = radial((k1, k2, k3, k4), t2)
    da, db = _decentre(a, b, t2, p1, p2)
    return a * k + da + sx1 * t2, b * k + db + sy1 * t2


def tangential(p: Parameters, a: Scalar, b: Scalar) -> Pair:
    """[a', b'] of `kannala-brandt-tangential`."""
    *core, k1, k2, k3, k4, p1, p2 = p
    return thin_prism((*core, k1, k2, p1, p2, k3, k4, 0.0, 0.0), a, b)


def rad_tan(p: Parameters, a: Scalar, b: Scalar) -> Pair:
    """[a', b'] of `rad-tan-thin-prism-fisheye`."""
    k, (p0, p1, s0, s1, s2, s3) = p[4:10], p[10:]
    factor = radial(k, a * a + b * b)
    g, h = a * factor, b * factor
    d2 = g * g + h * h
    dg, dh = _decentre(g, h, d2, p1, p0)
    return g + dg + d2 * (s0 + d2 * s1), h + dh + d2 * (s2 + d2 * s3)


def _fisheye(
    name: str,
    distortion: tuple[str, ...],
    distort: Formula,
    coefficients: Callable[[Parameters], Parameters],
) -> CameraModel:
    """A model of the angle; `coefficients`: those of its radial polynomial, of p."""
    undistort = implicit_inverse(distort, lambda _p, X, Y: (X, Y), 12)
    unit_scale = (1.0, 1.0)

    def project(p: Parameters, r: Scalar, s: Scalar, q: Scalar) -> Pair:
        a, b = _angle(unit_scale, r, s, q)
        # Before decentring, which may move a point across the turn, but not turn the image back.
        is_inside = is_increasing(coefficients(p), a * a + b * b)
        a, b = distort(p, a, b)
        u, v = p[2] + p[0] * a, p[3] + p[1] * b
        return jnp.where(is_inside, u, jnp.nan), jnp.where(is_inside, v, jnp.nan)

    def unproject(p: Parameters, u: Scalar, v: Scalar) -> Triple:
        return _ray(unit_scale, *undistort(p, (u - p[2]) / p[0], (v - p[3]) / p[1]))

    return CameraModel(
        name,
        (*CORE, *distortion),
        project=project,
        unproject=unproject,
        unit="px",
        image="equidistant",
    )


KANNALA_BRANDT_TANGENTIAL = _fisheye(
    "kannala-brandt-tangential",
    ("k1", "k2", "k3", "k4", "p1", "p2"),
    tangential,
    lambda p: p[4:8],
)
THIN_PRISM_FISHEYE = _fisheye(
    "thin-prism-fisheye",
    ("k1", "k2", "p1", "p2", "k3", "k4", "sx1", "sy1"),
    thin_prism,
    lambda p: (*p[4:6], *p[8:10]),
)
RAD_TAN_THIN_PRISM_FISHEYE = _fisheye(
    "rad-tan-thin-prism-fisheye",
    ("k0", "k1", "k2", "k3", "k4", "k5", "p0", "p1", "s0", "s1", "s2", "s3"),
    rad_tan,
    lambda p: p[4:10],
)
