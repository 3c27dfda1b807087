"""Conversion of camera models: exact if there is a formula, else by a fit over the image.

The difference is always measured: points of a grid over the image are projected back along the
rays of the source and forward through the target, and their displacement is reported.
"""

import dataclasses
from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Float

from jaxbundle.cameras.catalogue import get_model
from jaxbundle.cameras.convert_exact import (
    CORRECTIONS,
    DISTORTIONS,
    NotExact,
    Sizes,
    exact_parameters,
)
from jaxbundle.cameras.convert_fit import (
    come_back,
    fit_parameters,
    image_grid,
    images_of,
    rays_of,
    start_values,
)
from jaxbundle.cameras.convert_wide import exact_wide
from jaxbundle.cameras.model import CameraModel
from jaxbundle.cameras.parameters import default_parameters
from jaxbundle.cameras.pixel_frame import between_frames
from jaxbundle.cameras.validity import end_in_words
from jaxbundle.display import print_anywhere
from jaxbundle.types import Numbers

Area = tuple[Numbers, Numbers]
# Minimum part of the image with rays. Of less a fit says nothing about the rest, and such a
# distortion is rather a mistake in the parameters.
MEASURABLE = 0.5


@print_anywhere
@dataclasses.dataclass(frozen=True)
class Conversion:
    """A camera in its new model, and the differences.

    `largest` and `rms` are displacements in the measured image, in the target's `unit`, over the
    given area; `where` (target's coordinates) is the position of the largest. `covered` is the part
    of the area in which the source has rays. `reason` says why the conversion is not exact.
    """

    model: str
    parameters: Mapping[str, float]
    exact: bool
    largest: float
    rms: float
    unit: str
    where: tuple[float, float]
    covered: float
    reason: str = ""

    def __str__(self) -> str:
        how = "exact" if self.exact else f"fitted over the image, because {self.reason}"
        x, y = self.where
        text = (
            f"{self.model}: {how}; largest difference {self.largest:.3g} {self.unit} at "
            f"({x:.4g}, {y:.4g}), RMS {self.rms:.3g} {self.unit}"
        )
        if self.covered < 1:
            text += f"; {100 * (1 - self.covered):.1f} % of the image has no ray in the source"
        return text


def convert_camera(
    source: str | CameraModel,
    parameters: Mapping[str, float],
    target: str | CameraModel,
    *,
    image_size: Numbers | None = None,
    pixel_size: Numbers | None = None,
    area: Area | None = None,
    r0: float = 0.0,
    free: Sequence[str] = (),
) -> Conversion:
    """A camera of one model as a camera of another.

    **Arguments:**

    - `source`, `target`: models, or their names; `parameters`: of the source, by name; those left
      out have their defaults.
    - `image_size` (pixels), `pixel_size` (mm): required between pixels and millimetres or image
      centres.
    - `area`: the corners of the image (low, high) in the source's coordinates; by default the whole
      image.
    - `r0`: of the target, mm, if it has one.
    - `free`: the only parameters that the target may have beside its defaults; by default all, and
      `convert_fit.fitted_parameters` in a fit.

    **Raises:** `ValueError` naming a missing argument, or the reason why a fit is impossible.
    """
    # Parts of built-in models, as start values have them, share a name: objects stay as they are.
    source = get_model(source) if isinstance(source, str) else source
    target = get_model(target) if isinstance(target, str) else target
    values = {**default_parameters(source), **parameters}
    sizes = (image_size, pixel_size)
    shift, step = between_frames(source, target, *sizes)
    xy = image_grid(*(area or image_area(source, *sizes)))
    rays = rays_of(source, values, xy)
    has_ray = come_back(source, values, xy, rays)
    if has_ray.mean() < MEASURABLE:
        raise ValueError(
            f"only {100 * has_ray.mean():.0f} % of the image has a ray in model {source.name!r}: "
            f"its {' '.join(end_in_words(source))} inside the image"
        )
    target_images, rays = (shift + step * xy)[has_ray], rays[has_ray]
    if not target.wide and (rays[:, 2] >= 0).any():
        raise ValueError(
            f"part of the image looks 90° and more from the axis, where model {target.name!r} has "
            "no image; convert a smaller area, or keep the fisheye model"
        )
    try:
        converted, reason = _exact(source, values, target, sizes, r0), ""
        _check_defaults(converted, target, free)
    except NotExact as why:
        reason = str(why)
        starts = start_values(source, values, target, sizes, r0)
        if free:
            default = default_parameters(target)
            held_parameters = {name: v for name, v in default.items() if name not in free}
            starts = [{**start, **held_parameters} for start in starts]
        converted = fit_parameters(target, rays, target_images, starts, free)
    # Measured in any case: a formula is no proof that the two programs mean the same camera.
    difference = images_of(target, converted, rays) - target_images
    return _as_conversion(
        target, converted, reason, target_images, difference, float(has_ray.mean())
    )


def _as_conversion(
    target: CameraModel,
    converted: Mapping[str, float],
    reason: str,
    xy: Float[np.ndarray, "points 2"],
    difference: Float[np.ndarray, "points 2"],
    covered: float,
) -> Conversion:
    """A conversion with its differences at points xy of the target."""
    length = np.linalg.norm(difference, axis=1)
    if not np.isfinite(length).all():
        raise ValueError(
            f"model {target.name!r} has no image of {100 * np.isnan(length).mean():.0f} % of the "
            "image: its field of view is narrower; convert a smaller area, or to another model"
        )
    worst = int(np.argmax(length))
    # A fit may find the same camera, as of two models whose distortions are all zero. Rounding of
    # an inverse to double precision is some 1e-15 of the coordinates, enlarged by the distortion.
    if length[worst] <= 1e-12 * np.abs(xy).max():
        reason = ""
    return Conversion(
        target.name,
        {name: float(v) for name, v in converted.items()},
        not reason,
        float(length[worst]),
        float(np.sqrt(np.mean(length**2))),
        target.unit,
        (float(xy[worst, 0]), float(xy[worst, 1])),
        covered,
        reason,
    )


def _check_defaults(
    converted: Mapping[str, float], target: CameraModel, free: Sequence[str]
) -> None:
    """**Raises:** `NotExact` if a parameter that is not free has another value than its default."""
    default = default_parameters(target)
    not_default = [n for n, v in default.items() if free and n not in free and converted[n] != v]
    if not_default:
        raise NotExact(f"{', '.join(not_default)} must keep the default")


def _exact(
    source: CameraModel, values: Mapping[str, float], target: CameraModel, sizes: Sizes, r0: float
) -> dict[str, float]:
    """Exact conversion by the formulas of narrow cameras, or those of wide ones.

    **Raises:** `NotExact`.
    """
    pair = {source.name, target.name}
    narrow = source == target or pair <= {*CORRECTIONS} or pair <= {*DISTORTIONS}
    convert = exact_parameters if narrow else exact_wide
    return convert(source, values, target, sizes, r0)


def image_area(
    source: CameraModel, image_size: Numbers | None, pixel_size: Numbers | None
) -> tuple[Float[np.ndarray, "2"], Float[np.ndarray, "2"]]:
    """The corners of the whole image, in the model's coordinates."""
    if image_size is None:
        raise ValueError("image_size is needed to know the area of the image")
    size = np.asarray(image_size, float)
    if source.axes == "down":
        return np.full(2, -0.5), size - 0.5
    if source.unit == "mm":
        if pixel_size is None:
            raise ValueError("pixel_size is needed to know the area of the image in mm")
        size = size * np.asarray(pixel_size, float)
    return -size / 2, size / 2
