"""`equirectangular`: the panorama of a sphere, longitude along and latitude across.

    u = cx + fx·λ,  v = cy + fy·φ
    λ = atan2(X, Z),  φ = atan2(Y, √(X² + Z²))                       [X, Y, Z] = [r, −s, −q]

A complete panorama of w × h pixels has fx = w/(2π), fy = h/π, and its centre as principal point.

Range: all rays, −180° < λ ≤ 180° and |φ| ≤ 90°; pixels beyond have no ray, NaN. The seam lies
straight behind: a point measured on one side of it and computed on the other has a residual of the
width of the image, which data snooping removes. At the poles the longitude is undetermined.

A change of cx is a rotation about the vertical axis: it is not estimated by default.

Units: pixels, (0, 0) the centre of the upper-left pixel, u right, v down.

Source: Snyder (1987), Map Projections: A Working Manual, USGS Professional Paper 1395, section 12
(plate carrée); COLMAP's EQUIRECTANGULAR.
"""

import jax.numpy as jnp

from jaxbundle.cameras.model import CameraModel
from jaxbundle.cameras.scalars import Pair, Parameters, Scalar, Triple


def project(p: Parameters, r: Scalar, s: Scalar, q: Scalar) -> Pair:
    """The pixel of a ray: the formula of `equirectangular`."""
    fx, fy, cx, cy = p
    X, Y, Z = r, -s, -q
    return cx + fx * jnp.arctan2(X, Z), cy + fy * jnp.arctan2(Y, jnp.sqrt(X * X + Z * Z))


def unproject(p: Parameters, u: Scalar, v: Scalar) -> Triple:
    """The ray of a pixel."""
    fx, fy, cx, cy = p
    longitude, latitude = (u - cx) / fx, (v - cy) / fy
    is_inside = (jnp.abs(longitude) <= jnp.pi) & (jnp.abs(latitude) <= jnp.pi / 2)
    longitude = jnp.where(is_inside, longitude, jnp.nan)
    flat = jnp.cos(latitude)
    return flat * jnp.sin(longitude), -jnp.sin(latitude), -flat * jnp.cos(longitude)


EQUIRECTANGULAR = CameraModel(
    "equirectangular",
    ("fx", "fy", "cx", "cy"),
    project=project,
    unproject=unproject,
    unit="px",
    image="equidistant",
    free=("fx", "fy", "cy"),
)
