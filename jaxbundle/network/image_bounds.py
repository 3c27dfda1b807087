"""Points outside the image of their camera, which indicate another origin of coordinates or a wrong
image size."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float

from jaxbundle.cameras import get_model
from jaxbundle.cameras.convert import image_area
from jaxbundle.network.columns import count
from jaxbundle.network.tables import Camera, Network


def is_outside(camera: Camera, xy: Float[np.ndarray, "any 2"]) -> Bool[np.ndarray, " any"]:
    """Whether image points, in the unit of the model, are outside the camera's image; False if its
    size is unknown."""
    try:
        low, high = image_area(get_model(camera.model), camera.image_size, camera.pixel_size)
    except ValueError:
        return np.zeros(len(xy), bool)
    return np.any((xy < low) | (xy > high), axis=1)


def outside_warnings(cameras: Sequence[Camera], network: Network | None = None) -> tuple[str, ...]:
    """A message for every camera whose principal point or image points are outside."""
    warnings = []
    for c, camera in enumerate(cameras):
        model, size = get_model(camera.model), camera.image_size
        if size is None:
            continue
        origin = "image centre" if model.axes != "down" else "centre of the upper-left pixel"
        point = np.array([[camera.parameters.get(name, 0.0) for name in model.principal_point]])
        where = f"camera {camera.id!r}: "
        if point.size and is_outside(camera, point).any():
            warnings.append(
                f"{where}the principal point ({point[0, 0]:.6g}, {point[0, 1]:.6g}) {model.unit} "
                f"is outside the image of {size[0]} × {size[1]} pixels; relative to the {origin}"
            )
        if network is None:
            continue
        rays, images = network.observations, network.images
        rows = np.flatnonzero(images.camera[rays.image] == c)
        rows_outside = rows[is_outside(camera, rays.xy[rows])]
        if len(rows_outside):
            x, y = rays.xy[rows_outside[0]]
            warnings.append(
                f"{where}{len(rows_outside)} of {count(len(rows), 'image point')} outside the "
                f"image of {size[0]} × {size[1]} pixels, such as point "
                f"{network.points.id[rays.point[rows_outside[0]]]!r} of image "
                f"{images.id[rays.image[rows_outside[0]]]!r} at ({x:.6g}, {y:.6g}) {model.unit} "
                f"from the {origin}; check the origin of the coordinates and the image size"
            )
    return tuple(warnings)
