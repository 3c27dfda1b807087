"""Cameras as drawings: a pyramid from the projection centre through the corners of the image."""

import numpy as np
from jaxtyping import Float, Int

from jaxbundle.cameras import get_model
from jaxbundle.io.networks.assemble import all_parameters
from jaxbundle.io.networks.poses import matrices_of
from jaxbundle.network.tables import Camera, Network

CORNERS = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])


def pyramids(
    network: Network, length: float = 0.1
) -> tuple[Float[np.ndarray, "images 5 3"], Int[np.ndarray, "images 8 2"]]:
    """Corners of the pyramids, the projection centre first, and their edges.

    Edges are numbered through all corners of all images. Distortion is not drawn.

    **Arguments:** `length` of a pyramid relative to the distance from the cameras to the points
    (median): a tenth shows where a camera looks, and leaves the object visible.
    """
    images, points = network.images, network.points
    centre = images.position
    distance = 1.0
    if len(points) and np.isfinite(points.position).all(1).any():
        middle = np.nanmean(points.position, axis=0)
        distance = float(np.median(np.linalg.norm(centre - middle, axis=1)))
    half_sizes = np.array([_half_size(camera) for camera in network.cameras])[images.camera]
    rays = np.concatenate(
        [CORNERS[None] * half_sizes[:, None], np.full((len(images), 4, 1), -1.0)], axis=2
    )
    M = matrices_of(images.angles)
    corners = centre[:, None] + length * distance * rays @ M
    vertices = np.concatenate([centre[:, None], corners], axis=1)
    edges = np.array([[0, k] for k in range(1, 5)] + [[1, 2], [2, 3], [3, 4], [4, 1]])
    return vertices, edges[None] + 5 * np.arange(len(images))[:, None, None]


def _half_size(camera: Camera) -> tuple[float, float]:
    """Half width and half height of the image for the principal distance 1."""
    model, p = get_model(camera.model), all_parameters(camera)
    size = None if camera.image_size is None else np.array(camera.image_size, float)
    if model.unit == "mm" and size is not None:
        size = None if camera.pixel_size is None else size * camera.pixel_size
    if size is None:
        return 0.4, 0.3  # an image of unknown size: 4 : 3, 44° wide, as of a common lens
    focal = [p[name] for name in model.principal_distance]
    return tuple((size / 2 / focal).tolist())
