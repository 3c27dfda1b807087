"""The size of a pixel in the unit of a camera model, and the image of a board."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxbundle.cameras import CameraModel, project
from jaxbundle.errors import InputError
from jaxbundle.system.programs import compile_once
from jaxbundle.types import AnyArray


def unit_size(model: CameraModel, pixel_size: tuple[float, float] | None) -> tuple[float, float]:
    """Width and height of a pixel in the unit of the model.

    **Raises:** `InputError` if the model is in mm and the pixel size is missing.
    """
    if model.unit == "px":
        return 1.0, 1.0
    if pixel_size is None:
        raise InputError(
            f"camera model {model.name!r} is in mm: give the size of a pixel (--pixel-size 0.0045)"
        )
    return pixel_size


@partial(compile_once, static=0)
def _images(
    model: CameraModel,
    p: Float[AnyArray, " parameters"],
    position: Float[AnyArray, "views 3"],
    rotation: Float[AnyArray, "views 3 3"],
    points: Float[AnyArray, "points 3"],
) -> Float[Array, "views points 2"]:
    def image(
        X0: Float[AnyArray, "3"], M: Float[AnyArray, "3 3"], X: Float[AnyArray, "3"]
    ) -> Float[Array, "2"]:
        return jnp.stack(project(model, tuple(p), *(M @ (X - X0))))

    return jax.vmap(jax.vmap(image, (None, None, 0)), (0, 0, None))(position, rotation, points)


def images_of_board(
    model: CameraModel,
    p: Float[np.ndarray, " parameters"],
    position: Float[np.ndarray, "views 3"],
    rotation: Float[np.ndarray, "views 3 3"],
    points: Float[np.ndarray, "points 3"],
) -> Float[np.ndarray, "views points 2"]:
    """Image points of a board in the model's unit, for X0 and M of every view."""
    return np.array(_images(model, p, position, rotation, points))
