"""The image points of a network as rays, free of distortion.

A ray is the unit vector [r, s, q] from the projection centre in the camera frame, so that images of
all camera models are treated alike, those of fisheyes beyond 90° from the axis as well. Where a
method needs plane coordinates, (x, y) = (−r/q, −s/q) with c = 1, a virtual camera is turned towards
the rays (`in_plane`).
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

LEAST_FORWARD = 0.15
"""Least cosine of the angle between a ray and the axis of a camera (81°) for plane coordinates:
beyond it they grow without limit, and with them the effect of noise."""
PORTION = 4096


@dataclasses.dataclass(frozen=True)
class Sights:
    """Image points, ordered by image: which point in which image, the ray (unit vector in the
    camera frame) and its σ (radians, a priori).

    `tolerance`: by image, the allowed misclosure of start values: `TOLERANCE` times the extent of
    the image, radians. `row` is the row among the observations of the network. Image points outside
    the range of their camera have no ray and are not among these.
    """

    image: Int[np.ndarray, " n"]
    point: Int[np.ndarray, " n"]
    ray: Float[np.ndarray, "n 3"]
    sigma: Float[np.ndarray, " n"]
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
    d, sigma = np.full((len(rays), 3), np.nan), np.full(len(rays), np.nan)
    extent = np.ones(len(images))
    camera_of_ray = images.camera[rays.image]
    for c, camera in enumerate(network.cameras):
        rows = np.flatnonzero(camera_of_ray == c)
        if not len(rows):
            continue
        d[rows], sigma[rows] = rays_of(camera, rays.xy[rows], rays.sigma[rows])
        away = np.arctan2(np.hypot(d[rows, 0], d[rows, 1]), -d[rows, 2])
        if np.isfinite(away).any():
            extent[images.camera == c] = np.nanquantile(away, 0.95)
    rows = np.flatnonzero(np.isfinite(d).all(1))
    rows = rows[np.argsort(rays.image[rows], kind="stable")]
    return Sights(
        rays.image[rows],
        rays.point[rows],
        d[rows],
        sigma[rows],
        rows,
        tolerance * extent,
        len(network.points),
    )


def rays_of(
    camera: Camera, xy: Float[np.ndarray, "n 2"], sigma: Float[np.ndarray, "n 2"]
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, " n"]]:
    """Unit rays in the camera frame of points measured in the unit and axes of the camera's model,
    NaN outside its range; and the σ of their directions, RMS of both axes, radians."""
    model = get_model(camera.model)
    given = {**default_parameters(model), **camera.parameters}
    p = np.array([given[name] for name in model.parameters])
    portions = -(-len(xy) // PORTION)
    fill = lambda a: np.resize(a, (portions * PORTION, 2)).reshape(portions, PORTION, 2)
    found = [_portion(model, p, *parts) for parts in zip(fill(xy), fill(sigma))]
    d, noise = (np.concatenate([np.asarray(part[k]) for part in found]) for k in (0, 1))
    return d[: len(xy)], noise[: len(xy)]


def ideal_points(camera: Camera, xy: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 2"]:
    """x, y with c = 1, y up, of points measured in the unit and axes of the camera's model; NaN for
    those to the side of the camera."""
    ray, _ = rays_of(camera, xy, np.ones_like(xy))
    return _in_plane(ray)


def in_plane(
    rays: Float[np.ndarray, "n 3"],
) -> tuple[Float[np.ndarray, "3 3"], Float[np.ndarray, "n 2"]]:
    """R and the coordinates x, y, with c = 1, of rays in the camera turned by R: the camera of the
    rays itself if they are all before it, else one whose axis is their mean. NaN for rays that are
    not before that one either."""
    if (-rays[:, 2] > LEAST_FORWARD).all():
        return np.eye(3), _in_plane(rays)
    axis = -rays.mean(0)
    # The rotation that takes the axis to z; about x or y, whichever is farther from it.
    other = np.eye(3)[np.argmin(np.abs(axis[:2]))]
    z = axis / np.linalg.norm(axis)
    x = other - (other @ z) * z
    x /= np.linalg.norm(x)
    R = np.stack([x, np.cross(z, x), z])
    return R, _in_plane(rays @ R.T)


def _in_plane(ray):
    there = -ray[:, 2] > LEAST_FORWARD
    return np.where(there[:, None], ray[:, :2] / np.where(there, -ray[:, 2], 1.0)[:, None], np.nan)


@partial(compile_once, static=0)
def _portion(model, p, xy, sigma):
    ray = lambda x, y: jnp.stack(image_ray(model, tuple(p), x, y))

    def one(xy, sigma):
        d = ray(*xy)
        # σ is small beside the image: the rays one σ away are as good as a derivative.
        moved = jnp.stack([ray(xy[0] + sigma[0], xy[1]), ray(xy[0], xy[1] + sigma[1])])
        return d, jnp.sqrt(jnp.sum((moved - d) ** 2) / 2)

    return jax.vmap(one)(xy, sigma)
