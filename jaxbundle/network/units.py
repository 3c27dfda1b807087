"""Units of a project: angles, and image coordinates in millimetres or pixels.

Pixel (0, 0) is the centre of the upper-left pixel, u to the right, v down; in millimetres the
origin is the image centre, x to the right, y up:

    x = (u − (w − 1)/2)·p_x        y = −(v − (h − 1)/2)·p_y

with the image size (w, h) in pixels and the pixel size (p_x, p_y) in mm. Inside a network an
image coordinate has the unit and axes of its camera's model, regardless of the project's unit.

A model in pixels uses the pixels of a project unchanged; if its y axis points up (`snavely`),
they are relative to the image centre, as in BAL.
"""

import math
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Int

from jaxbundle.cameras import get_model
from jaxbundle.cameras.pixel_frame import pixel_frame
from jaxbundle.choices import ANGLE_UNIT_NAMES
from jaxbundle.errors import InputError
from jaxbundle.network.tables import Camera, Network, units_of

# Radians in one unit.
ANGLE_UNITS: dict[str, float] = dict(
    zip(ANGLE_UNIT_NAMES, (1.0, math.pi / 180, math.pi / 200), strict=True)
)

# Metres in one unit of length; "ftUS" is the survey foot.
METRES: dict[str, float] = {
    "nm": 1e-9,
    "um": 1e-6,
    "µm": 1e-6,
    "μm": 1e-6,
    "mm": 1e-3,
    "cm": 1e-2,
    "dm": 1e-1,
    "m": 1.0,
    "km": 1e3,
    "in": 0.0254,
    "ft": 0.3048,
    "ftUS": 1200 / 3937,
}

IMAGE_UNITS = ("mm", "px")


def unit_words(network: Network) -> dict[str, tuple[float, str]]:
    """By the words of `Kind.units`: the factor from the unit of computation, and the name of the
    unit in tables; of image coordinates that of the camera models, whatever that of the input."""
    return {
        "length": (1.0, network.object_unit),
        "angle": (1 / ANGLE_UNITS[network.angle_unit], network.angle_unit),
        "image": (1.0, units_of(network.cameras)),
        "velocity": (1.0, f"{network.object_unit}/s"),
        "time": (1.0, "s"),
    }


def image_from_pixel(
    uv: Float[np.ndarray, "*any 2"], image_size: tuple[int, int], pixel_size: tuple[float, float]
) -> Float[np.ndarray, "*any 2"]:
    """Millimetres from the image centre, y up, of pixels, v down.

    **Arguments:** `image_size` (columns, rows); `pixel_size` (width, height) in mm.
    """
    return _to_mm(uv, *_grid(image_size, pixel_size))


def pixel_from_image(
    xy: Float[np.ndarray, "*any 2"], image_size: tuple[int, int], pixel_size: tuple[float, float]
) -> Float[np.ndarray, "*any 2"]:
    """The inverse of `image_from_pixel`."""
    return _to_px(xy, *_grid(image_size, pixel_size))


def _to_mm(
    uv: Float[np.ndarray, "*n 2"],
    centre: Float[np.ndarray, "*n 2"],
    pitch: Float[np.ndarray, "*n 2"],
) -> Float[np.ndarray, "*n 2"]:
    return (uv - centre) * pitch


def _to_px(
    xy: Float[np.ndarray, "*n 2"],
    centre: Float[np.ndarray, "*n 2"],
    pitch: Float[np.ndarray, "*n 2"],
) -> Float[np.ndarray, "*n 2"]:
    return xy / pitch + centre


def _grid(
    image_size: Sequence[float], pixel_size: Sequence[float]
) -> tuple[Float[np.ndarray, "2"], Float[np.ndarray, "2"]]:
    """The image centre (pixels) and the pixel size (mm, negative where v runs down)."""
    centre, per_mm = pixel_frame(get_model("brown"), image_size, pixel_size)
    return centre, 1 / per_mm


def from_image_unit(
    cameras: Sequence[Camera],
    camera: Int[np.ndarray, " rays"],
    xy: Float[np.ndarray, "rays 2"],
    sigma: Float[np.ndarray, "rays 2"],
    image_unit: str,
) -> tuple[Float[np.ndarray, "rays 2"], Float[np.ndarray, "rays 2"]]:
    """Image coordinates and their σ from the project's unit to that of each camera's model.

    **Raises:** `InputError` if a conversion needs a missing image or pixel size.
    """
    return _convert(cameras, camera, xy, sigma, [image_unit] * len(cameras), _units(cameras))


def to_image_unit(
    cameras: Sequence[Camera],
    camera: Int[np.ndarray, " rays"],
    xy: Float[np.ndarray, "rays 2"],
    sigma: Float[np.ndarray, "rays 2"],
    image_unit: str,
) -> tuple[Float[np.ndarray, "rays 2"], Float[np.ndarray, "rays 2"]]:
    """The inverse of `from_image_unit`."""
    return _convert(cameras, camera, xy, sigma, _units(cameras), [image_unit] * len(cameras))


def _units(cameras: Sequence[Camera]) -> list[str]:
    return [get_model(camera.model).unit for camera in cameras]


def _convert(
    cameras: Sequence[Camera],
    camera: Int[np.ndarray, " n"],
    xy: Float[np.ndarray, "n 2"],
    sigma: Float[np.ndarray, "n 2"],
    source_units: Sequence[str],
    target_units: Sequence[str],
) -> tuple[Float[np.ndarray, "n 2"], Float[np.ndarray, "n 2"]]:
    """Per camera: nothing, pixels to mm, or mm to pixels."""
    if list(source_units) == list(target_units):
        return xy, sigma
    # Only cameras whose unit differs need sizes: the others must not be refused for lacking them.
    centre, pitch = np.zeros((len(cameras), 2)), np.ones((len(cameras), 2))
    for c in np.unique(camera):
        if source_units[c] != target_units[c]:
            centre[c], pitch[c] = _pixel_grid(cameras[c])
    centre, pitch = centre[camera], pitch[camera]
    to_mm = np.array([(h, w) == ("px", "mm") for h, w in zip(source_units, target_units)])[
        camera, None
    ]
    to_px = np.array([(h, w) == ("mm", "px") for h, w in zip(source_units, target_units)])[
        camera, None
    ]
    converted = np.where(to_px, _to_px(xy, centre, pitch), xy)
    xy = np.where(to_mm, _to_mm(xy, centre, pitch), converted)
    size = np.abs(pitch)
    return xy, np.where(to_mm, sigma * size, np.where(to_px, sigma / size, sigma))


def _pixel_grid(camera: Camera) -> tuple[Float[np.ndarray, "2"], Float[np.ndarray, "2"]]:
    """The image centre (pixels) and the pixel size (mm; negative where v runs down)."""
    model = get_model(camera.model)
    centred = (model.unit, model.axes) == ("px", "up")
    if camera.pixel_size is None:
        raise _require_size(camera, "pixel_size", "[width, height] in mm")
    if centred:
        return np.zeros(2), np.array(camera.pixel_size)
    if camera.image_size is None:
        raise _require_size(camera, "image_size", "[columns, rows]")
    return _grid(camera.image_size, camera.pixel_size)


def _require_size(camera: Camera, name: str, meaning: str) -> InputError:
    return InputError(
        f"camera {camera.id!r}: {name} is needed to convert between pixels and mm; "
        f"give {name} = {meaning}"
    )
