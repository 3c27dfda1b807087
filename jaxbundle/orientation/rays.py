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
from jax import Array
from jaxtyping import Float, Int

from jaxbundle.cameras import CameraModel, default_parameters, get_model, image_ray
from jaxbundle.network.kinds.interfaces import Interfaces
from jaxbundle.network.tables import Camera, Network
from jaxbundle.system.programs import compile_once
from jaxbundle.types import Index

# Of the angle between a ray and the axis of a camera (81°) for plane coordinates: beyond it they
# grow without limit, and with them the effect of noise: across the axis by 1/cos = 6.7, along the
# radius by its square.
MIN_COSINE = 0.15
# Largest unknown lens distortion, relative to the image extent, the angle to the axis that 95 % of
# the rays do not exceed: that of wide-angle lenses of consumer cameras, whose parameters are not
# known before the adjustment; 43 pixels of a photograph of 3000 × 2000 whose c is its longer side.
# Smaller: such images are not oriented; larger: blunders of that size are accepted as start values.
TOLERANCE = 0.03


@dataclasses.dataclass(frozen=True)
class Sights:
    """Image points, ordered by image: which point in which image, the ray (unit vector in the
    camera frame) and its σ (radians, a priori).

    `tolerance`: by image, the allowed misclosure of start values: `TOLERANCE` times the extent of
    the image, the angle to the axis that 95 % of its camera's rays do not exceed, radians. `row` is
    the row among the observations of the network. Image points outside the range of their camera
    have no ray and are not among these.
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

    def rows_of(self, image: Index) -> slice:
        """The rows of an image."""
        begin, end = np.searchsorted(self.image, [int(image), int(image) + 1])
        return slice(begin, end)


def make_sights(network: Network, tolerance: float = TOLERANCE) -> Sights:
    """The image points of a network with the interior orientation it gives.

    **Arguments:** `tolerance`: of start values, relative to the extent of an image (`Sights`)."""
    rays, images = network.observations, network.images
    d, sigma = np.full((len(rays), 3), np.nan), np.full(len(rays), np.nan)
    extent = np.ones(len(images))
    camera_of_ray = images.camera[rays.image]
    for c, camera in enumerate(network.cameras):
        rows = np.flatnonzero(camera_of_ray == c)
        if not len(rows):
            continue
        d[rows], sigma[rows] = rays_of(camera, rays.xy[rows], rays.sigma[rows])
        for interfaces in network.further:
            if isinstance(interfaces, Interfaces):
                d[rows] = interfaces.directions(camera.id, d[rows])
        axis_angle = np.arctan2(np.hypot(d[rows, 0], d[rows, 1]), -d[rows, 2])
        # The 95 % quantile: a few image points far outside are blunders, not the extent.
        if np.isfinite(axis_angle).any():
            extent[images.camera == c] = np.nanquantile(axis_angle, 0.95)
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
    parameters = {**default_parameters(model), **camera.parameters}
    p = np.array([parameters[name] for name in model.parameters])
    # In batches of one size, so that one program serves all networks. Larger ones make small
    # networks wait for rays they do not have, smaller ones cost calls.
    batch = 4096
    batches = -(-len(xy) // batch)
    fill = lambda a: np.resize(a, (batches * batch, 2)).reshape(batches, batch, 2)
    computed = [_rays_of_batch(model, p, *parts) for parts in zip(fill(xy), fill(sigma))]
    d, noise = (np.concatenate([np.asarray(part[k]) for part in computed]) for k in (0, 1))
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
    if (-rays[:, 2] > MIN_COSINE).all():
        return np.eye(3), _in_plane(rays)
    axis = -rays.mean(0)
    # The new x is the old x or y made perpendicular to the new z: of these the one farther from z,
    # which is never parallel to it.
    start_axis = np.eye(3)[np.argmin(np.abs(axis[:2]))]
    z = axis / np.linalg.norm(axis)
    x = start_axis - (start_axis @ z) * z
    x /= np.linalg.norm(x)
    R = np.stack([x, np.cross(z, x), z])
    return R, _in_plane(rays @ R.T)


def _in_plane(ray: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 2"]:
    is_in_front = -ray[:, 2] > MIN_COSINE
    return np.where(
        is_in_front[:, None], ray[:, :2] / np.where(is_in_front, -ray[:, 2], 1.0)[:, None], np.nan
    )


@partial(compile_once, static=0)
def _rays_of_batch(
    model: CameraModel,
    p: Float[Array, " parameters"],
    xy: Float[Array, "batch 2"],
    sigma: Float[Array, "batch 2"],
) -> tuple[Float[Array, "batch 3"], Float[Array, " batch"]]:
    ray = lambda x, y: jnp.stack(image_ray(model, tuple(p), x, y))

    def ray_and_sigma(
        xy: Float[Array, "2"], sigma: Float[Array, "2"]
    ) -> tuple[Float[Array, "3"], Float[Array, ""]]:
        d = ray(*xy)
        # σ is small beside the image: the rays one σ away are as good as a derivative.
        displaced = jnp.stack([ray(xy[0] + sigma[0], xy[1]), ray(xy[0], xy[1] + sigma[1])])
        return d, jnp.sqrt(jnp.sum((displaced - d) ** 2) / 2)

    return jax.vmap(ray_and_sigma)(xy, sigma)
