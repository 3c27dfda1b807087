"""The image points of a network as directions, free of distortion.

(x, y) = (−r/q, −s/q) of the ray [r, s, q] of an image point, so that images of all camera models
are those of one with c = 1. Points more than about 80° from the axis have no such coordinates
and are excluded.
"""

import dataclasses
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from jaxbundle.cameras import default_parameters, get_model, image_ray
from jaxbundle.network.tables import Camera, Network
from jaxbundle.system.programs import compile_once
from jaxbundle.types import Index

LEAST_FORWARD = -0.15
"""Least −q of a unit ray that counts as in front of the camera."""
PORTION = 4096


@dataclasses.dataclass(frozen=True)
class Sights:
    """Image points, ordered by image: which point in which image, where (c = 1).

    `tolerance`: by image, the allowed misclosure of start values: `TOLERANCE` times the extent of
    the image. `row` is the row among the observations of the network.
    """

    image: Int[np.ndarray, " n"]
    point: Int[np.ndarray, " n"]
    xy: Float[np.ndarray, "n 2"]
    row: Int[np.ndarray, " n"]
    tolerance: Float[np.ndarray, " images"]
    points: int

    @property
    def images(self) -> int:
        return len(self.tolerance)

    def of(self, image: Index) -> slice:
        """The rows of an image."""
        first, last = np.searchsorted(self.image, [int(image), int(image) + 1])
        return slice(first, last)


TOLERANCE = 0.03
"""Largest unknown lens distortion, relative to the image extent."""


def sights(network: Network, tolerance: float = TOLERANCE) -> Sights:
    """The image points of a network with the interior orientation it gives.

    **Arguments:** `tolerance`: of start values, in parts of the extent of a picture."""
    rays, images = network.observations, network.images
    xy = np.full((len(rays), 2), np.nan)
    extent = np.ones(len(images))
    camera_of_ray = images.camera[rays.image]
    for c, camera in enumerate(network.cameras):
        rows = np.flatnonzero(camera_of_ray == c)
        if not len(rows):
            continue
        xy[rows] = ideal_points(camera, rays.xy[rows])
        radius = np.linalg.norm(xy[rows], axis=1)
        extent[images.camera == c] = np.nanquantile(radius, 0.95) if len(radius) else 1.0
    rows = np.flatnonzero(np.isfinite(xy).all(1))
    rows = rows[np.argsort(rays.image[rows], kind="stable")]
    limit = tolerance * np.where(np.isfinite(extent), extent, 1.0)
    return Sights(rays.image[rows], rays.point[rows], xy[rows], rows, limit, len(network.points))


def ideal_points(camera: Camera, xy: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 2"]:
    """x, y with c = 1, y up, of points measured in the unit and axes of the camera's model; NaN for
    those to the side of the camera."""
    model = get_model(camera.model)
    given = {**default_parameters(model), **camera.parameters}
    p = np.array([given[name] for name in model.parameters])
    portions = -(-len(xy) // PORTION)
    filled = np.resize(xy, (portions * PORTION, 2)).reshape(portions, PORTION, 2)
    found = np.concatenate([np.asarray(_portion(model, p, part)) for part in filled])
    return found[: len(xy)]


@partial(compile_once, static=0)
def _portion(model, p, xy):
    def one(xy):
        r, s, q = image_ray(model, tuple(p), xy[0], xy[1])
        return jnp.where(q < LEAST_FORWARD, jnp.stack([-r / q, -s / q]), jnp.nan)

    return jax.vmap(one)(xy)
