"""The image coordinates of a model as pixels, and back.

A pixel (u, v) counts from the centre of the upper-left pixel, u right, v down. The coordinates
(x, y) of a model (its unit and axes) belong to it by

    u = u_o + a·x,  v = v_o + b·y

| unit, axes | u_o, v_o | a, b |
|---|---|---|
| px, down | 0, 0 | 1, 1 |
| px, up | (w − 1)/2, (h − 1)/2 | 1, −1 |
| mm, up | (w − 1)/2, (h − 1)/2 | 1/p_x, −1/p_y |

with the image size (w, h) in pixels and the pixel size (p_x, p_y) in mm.
"""

import numpy as np
from jaxtyping import Float

from jaxbundle.cameras.model import CameraModel
from jaxbundle.types import Numbers


def pixel_frame(
    model: CameraModel,
    image_size: Numbers | None = None,
    pixel_size: Numbers | None = None,
) -> tuple[Float[np.ndarray, "2"], Float[np.ndarray, "2"]]:
    """Origin (u_o, v_o) and step (a, b) of a model's image coordinates, in pixels.

    **Raises:** `ValueError` naming the size that is needed and not given.
    """
    if model.axes == "down":
        return np.zeros(2), np.ones(2)
    if image_size is None:
        raise ValueError("image_size is needed to relate its coordinates to pixels")
    # (0, 0) is the centre of the first pixel, so the centre of the image is at (w − 1)/2.
    centre = (np.asarray(image_size, float) - 1) / 2
    if model.unit == "px":
        return centre, np.array([1.0, -1.0])
    if pixel_size is None:
        raise ValueError("pixel_size is needed to relate millimetres to pixels")
    return centre, np.array([1.0, -1.0]) / np.asarray(pixel_size, float)


def in_model_units(
    uv: Float[np.ndarray, "*any 2"],
    model: CameraModel,
    image_size: Numbers | None,
    pixel_size: Numbers | None = None,
) -> Float[np.ndarray, "*any 2"]:
    """Pixels (v down) as the model counts: as they are; from the image centre, y up; in mm."""
    origin, step = pixel_frame(model, image_size, pixel_size)
    return (np.asarray(uv, float) - origin) / step


def in_pixels(
    xy: Float[np.ndarray, "*any 2"],
    model: CameraModel,
    image_size: Numbers | None,
    pixel_size: Numbers | None = None,
) -> Float[np.ndarray, "*any 2"]:
    """The inverse of `in_model_units`."""
    origin, step = pixel_frame(model, image_size, pixel_size)
    return origin + step * np.asarray(xy, float)


def between_frames(
    source: CameraModel,
    target: CameraModel,
    image_size: Numbers | None = None,
    pixel_size: Numbers | None = None,
) -> tuple[Float[np.ndarray, "2"], Float[np.ndarray, "2"]]:
    """Shift d and factor s with (x, y)_target = d + s·(x, y)_source.

    Models of the same unit and axes need no sizes.

    **Raises:** `ValueError` naming the size that is needed and not given.
    """
    if (source.unit, source.axes) == (target.unit, target.axes):
        return np.zeros(2), np.ones(2)
    origin, step = pixel_frame(source, image_size, pixel_size)
    target_origin, target_step = pixel_frame(target, image_size, pixel_size)
    return (origin - target_origin) / target_step, step / target_step
