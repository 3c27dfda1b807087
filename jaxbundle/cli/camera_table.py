"""The output of `jaxbundle camera`: parameters, field of view, distortion."""

from collections.abc import Mapping, Sequence

import numpy as np

from jaxbundle.cameras import get_model
from jaxbundle.cameras.distortion_table import distortion_table
from jaxbundle.cameras.field_of_view import (
    angle_class,
    equivalent_35mm,
    field_of_view,
    field_of_view_of_rays,
)
from jaxbundle.errors import InputError
from jaxbundle.io.networks.assemble import all_parameters
from jaxbundle.network.tables import Camera

Pair = tuple[float, float]


def sizes_of(
    file: str, given: Camera, size: Pair | None, pitch: Pair | None
) -> tuple[Pair, Pair | None]:
    """Image and pixel size of a camera, from the options or the camera.

    **Raises:** `InputError` if one is missing.
    """
    size, pitch = size or given.image_size, pitch or given.pixel_size
    if size is None or (get_model(given.model).unit == "mm" and pitch is None):
        missing = "image_size" if size is None else "pixel_size"
        raise InputError(
            f"{file}: camera {given.id!r} has no {missing}; see --image-size and --pixel-size"
        )
    return size, pitch


def table_of(given: Camera, reach: float, step: float, about_origin: bool) -> dict[str, np.ndarray]:
    """Distortion by radius.

    **Raises:** `InputError` for an impossible step.
    """
    about = "origin" if about_origin else "principal point"
    try:
        return distortion_table(get_model(given.model), given.parameters, step, reach, about)
    except ValueError as error:
        raise InputError(f"--step: {error}") from None


def print_camera(
    given: Camera,
    extent: Sequence[float],
    size: Pair,
    pitch: Pair | None,
    table: Mapping[str, np.ndarray],
) -> None:
    """Print parameters, field of view and table of a camera."""
    model, p = get_model(given.model), all_parameters(given)
    focal = [p[name] for name in model.principal_distance]
    print(f"camera {given.id!r}, model {given.model}, {extent[0]:g} × {extent[1]:g} {model.unit}")
    for name, value in p.items():
        if value:
            print(f"{name:22}{value:.8g}")
    views = {
        "2·atan(d/2c)": field_of_view(focal, extent),
        "by the rays": field_of_view_of_rays(model, p, size, pitch),
    }
    for name, view in views.items():
        angles = ", ".join(f"{np.degrees(angle):.3f}°" for angle in view)
        print(f"{'field of view':22}{angles} (horizontal, vertical, diagonal), {name}")
    print(f"{'':22}{angle_class(views['2·atan(d/2c)'].diagonal)}")
    print(
        f"{'35 mm equivalent':22}{equivalent_35mm(focal, extent):.2f} mm by the diagonal, "
        f"{equivalent_35mm(focal, extent, 'width'):.2f} mm by the width"
    )
    print(f"{'r':>12}{'radial':>12}{'decentring':>12}  [{model.unit}], measured − ideal")
    for row in zip(*table.values()):
        print("".join(f"{value:12.5g}" for value in row))
