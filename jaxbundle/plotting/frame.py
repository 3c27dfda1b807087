"""The frame of an image: its corners and its measurements."""

from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float

from jaxbundle.cameras import get_model
from jaxbundle.plotting.distortion import camera_index

if TYPE_CHECKING:
    from jaxbundle.adjustment.result import Adjustment


def image_frame(
    adjustment: "Adjustment", camera: str
) -> tuple[Float[np.ndarray, "2"], Float[np.ndarray, "2"], bool]:
    """The corners of a camera's image, and whether they are known.

    **Returns:** lowest and highest (x, y), in the unit of the camera's model, and True if they
    follow from the image size; else the rectangle of the measurements, and False.
    """
    network = adjustment.problem.network
    c = camera_index(adjustment, camera)
    network_camera, model = network.cameras[c], get_model(network.cameras[c].model)
    size, pitch = network_camera.image_size, network_camera.pixel_size
    if size is not None and model.unit == "px":
        half_size = np.array(size) / 2
        # The first pixel has its centre, not its corner, at 0.
        centre = half_size - 0.5 if model.axes == "down" else np.zeros(2)
        return centre - half_size, centre + half_size, True
    if size is not None and pitch is not None:
        half_size = np.array(size) * np.abs(pitch) / 2
        return -half_size, half_size, True
    is_of_camera = adjustment.problem.camera == c
    xy = adjustment.problem.image_coordinates()[is_of_camera]
    if not len(xy):
        return -np.ones(2), np.ones(2), False
    return xy.min(0), xy.max(0), False


def measured(adjustment: "Adjustment", image: str) -> tuple[np.ndarray, ...]:
    """The measurements in an image: points, coordinates [n, 2], residuals [n, 2], τ [n, 2].

    Coordinates and v = computed − observed in the unit of the camera's model; τ and v of a
    removed coordinate are NaN.
    """
    problem = adjustment.problem
    i = image_index(adjustment, image)
    weight = problem.image_weights
    rows = np.flatnonzero((problem.image == i) & (weight > 0).any(1))
    weight = np.where(weight[rows] > 0, weight[rows], np.nan)
    reliability = adjustment.reliability
    ids = np.array(adjustment.problem.network.points.id, dtype=object)
    return (
        ids[problem.point[rows]],
        problem.image_coordinates()[rows],
        problem.image_points(reliability.residual)[rows] / weight,
        adjustment.pope(problem.image_points(reliability.w)[rows]),
    )


def image_index(adjustment: "Adjustment", image: str) -> int:
    """The row of an image in the arrays."""
    ids = adjustment.problem.network.images.id
    if str(image) not in ids:
        raise KeyError(f"there is no image {image!r}; images: {', '.join(ids[:20])}")
    return ids.index(str(image))


def pyramid_lines(pyramids: Float[np.ndarray, "images 5 3"]) -> Float[np.ndarray, "images 8 2 3"]:
    """The edges of pyramids, each of an apex and four corners in order: slanted ones first."""
    slanted, around = [(0, k) for k in (1, 2, 3, 4)], [(1, 2), (2, 3), (3, 4), (4, 1)]
    return pyramids[:, np.array([*slanted, *around])]
