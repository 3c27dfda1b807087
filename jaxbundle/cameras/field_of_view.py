"""The field of view of a camera, and the equivalent principal distance of a small-format camera.

    FOV = 2·atan(d/(2c))        d: width, height or diagonal of the image

and for different principal distances along and across (fx ≠ fy), each with its side:

    d/c = w/fx,  h/fy,  √((w/fx)² + (h/fy)²)

the three definitions in use. From rays, including distortion and principal point, it
is the angle between the rays through the ends of d; both agree for an undistorted camera with
its principal point at the image centre.

Source: Wolf, Dewitt and Wilkinson (2014), Elements of Photogrammetry, section 3-3, whose classes
are those of the diagonal: normal angle to 75°, wide angle to 100°, superwide beyond.
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from jaxbundle.cameras.convert import image_area
from jaxbundle.cameras.convert_fit import rays_of
from jaxbundle.cameras.model import CameraModel
from jaxbundle.cameras.parameters import default_parameters
from jaxbundle.types import Numbers

# Width and height of a small-format ("35 mm") image, mm.
SMALL_FORMAT = (36.0, 24.0)
CLASSES = ((75.0, "normal angle"), (100.0, "wide angle"), (np.inf, "superwide angle"))


class FieldOfView(NamedTuple):
    """Angles across the image, radians."""

    horizontal: float
    vertical: float
    diagonal: float


def field_of_view(c: float | Sequence[float], size: Sequence[float]) -> FieldOfView:
    """FOV = 2·atan(d/(2c)) of an image of (width, height), in the unit of c, or of (fx, fy)."""
    width, height = np.divide(size, c)
    angle = lambda d: float(2 * np.arctan(d / 2))
    return FieldOfView(angle(width), angle(height), angle(np.hypot(width, height)))


def field_of_view_of_rays(
    model: CameraModel,
    parameters: Mapping[str, float],
    image_size: Sequence[float],
    pixel_size: Numbers | None = None,
) -> FieldOfView:
    """The angles between the rays through the centres of the edges, and the corners, of the image.

    The diagonal is the larger of the two. NaN if the model has no ray.
    """
    low, high = image_area(model, image_size, pixel_size)
    x, y = (low + high) / 2
    ends = [
        ((low[0], y), (high[0], y)),
        ((x, low[1]), (x, high[1])),
        (low, high),
        ((low[0], high[1]), (high[0], low[1])),
    ]
    values = {**default_parameters(model), **parameters}
    rays = rays_of(model, values, np.array(ends).reshape(-1, 2)).reshape(4, 2, 3)
    a, b = rays[:, 0], rays[:, 1]
    # The angle at the sphere by its tangent: exact for small and large ones alike.
    angles = np.arctan2(np.linalg.norm(np.cross(a, b), axis=1), (a * b).sum(1))
    # Beyond 180° the opening looks to the other side.
    middle = a + b
    angles = np.where(middle[:, 2] > 0, 2 * np.pi - angles, angles)
    return FieldOfView(float(angles[0]), float(angles[1]), float(angles[2:].max()))


def angle_class(diagonal: float) -> str:
    """Normal, wide or superwide angle, by the diagonal field of view in radians."""
    return next(name for limit, name in CLASSES if np.degrees(diagonal) < limit)


def equivalent_35mm(
    c: float | Sequence[float], size: Sequence[float], by: str = "diagonal"
) -> float:
    """The principal distance, mm, with the same field of view on 36 × 24 mm.

    **Arguments:** `c`, or (fx, fy), and `size` (width, height) in one unit; `by` diagonal (as by
    CIPA), width or height.

    **Raises:** `ValueError` for another definition.
    """
    lengths = {"diagonal": np.hypot, "width": lambda w, _h: w, "height": lambda _w, h: h}
    if by not in lengths:
        raise ValueError(f"the equivalent is by diagonal, width or height, not by {by!r}")
    return float(lengths[by](*SMALL_FORMAT) / lengths[by](*np.divide(size, c)))
