"""What a writer requires of a network, and what its format cannot hold."""

from collections.abc import Sequence

import numpy as np

from jaxbundle.errors import InputError
from jaxbundle.io.networks.assemble import all_parameters
from jaxbundle.network.tables import Camera, Network

PIXEL_MODELS = ("opencv", "kannala-brandt")
"""Camera models common to formats of computer vision."""
CORE = ("fx", "fy", "cx", "cy")
GREY = (128, 128, 128)
"""Red, green, blue of points in formats that require a colour, which a network does not have."""


def need_values(network: Network, model: str = "", format: str = "", points: bool = True) -> None:
    """Refuse a network without orientations, coordinates, or the only model of a format.

    **Raises:** `InputError` naming camera, image or point.
    """
    for camera in network.cameras:
        if model and camera.model != model:
            raise InputError(
                f"camera {camera.id!r}: {format} has no model {str(camera.model)!r}; convert it "
                f"with --model {model}"
            )
    images, object_points = network.images, network.points
    tables = [
        (images, images.position, "image", "orientation"),
        (images, images.angles, "image", "orientation"),
        (object_points, object_points.position, "point", "coordinates"),
    ]
    for table, values, thing, what in tables[: 3 if points else 2]:
        for row, *_ in np.argwhere(~np.isfinite(values))[:1]:
            raise InputError(
                f"{table.source(row)}: {thing} {table.id[row]!r} has no {what} to be written"
            )


def describe_losses(
    network: Network, shared_cameras: bool = False, names: bool = False, rays: bool = False
) -> tuple[str, ...]:
    """Messages about parts of a network that formats of computer vision cannot hold.

    **Arguments:** `shared_cameras` whether every image gets its own camera; `names` whether
    ids become numbers; `rays` whether image points are lost.
    """
    images, points = network.images, network.points
    lost = {
        "roles and σ of control, fixed and check points": not points.has_role("tie").all(),
        "prior σ of exterior orientations": not np.isnan(images.sigma).all(),
        "σ of image points": len(np.unique(network.observations.sigma)) > 1,
        "distances": len(network.distances) > 0,
        **{kind.TABLE: True for kind in network.further},
        "that images share a camera": shared_cameras and len(network.cameras) < len(images),
        "names of images and points, which are numbered from 0": names
        and not are_numbered_from_0(images.id, points.id),
        "image points": rays and len(network.observations) > 0,
    }
    return tuple(what for what, there in lost.items() if there)


def are_numbered_from_0(*ids: Sequence[str]) -> bool:
    """Whether the names of each table are 0, 1, 2, …, as a format counts them."""
    return all(list(names) == [str(k) for k in range(len(names))] for names in ids)


def check_others_zero(camera: Camera, format: str, coefficients: Sequence[str]) -> dict[str, float]:
    """All parameters of a camera of one of the `PIXEL_MODELS`, for a format with some of the
    coefficients.

    **Raises:** `InputError` for another model, and for a coefficient the format does not have.
    """
    where = f"camera {camera.id!r}: {format} has no"
    if camera.model not in PIXEL_MODELS:
        raise InputError(f"{where} model {str(camera.model)!r}; convert it with --model opencv")
    p = all_parameters(camera)
    rest = [name for name, value in p.items() if value and name not in (*CORE, *coefficients)]
    if rest:
        raise InputError(f"{where} {', '.join(rest)}; adjust the camera without")
    return p


def one_focal_length(camera: Camera, format: str) -> float:
    """fx, which must equal fy.

    **Raises:** `InputError`.
    """
    p = all_parameters(camera)
    if p["fx"] != p["fy"]:
        raise InputError(
            f"camera {camera.id!r}: {format} has one focal length, but fx is {p['fx']:.9g} and fy "
            f'{p["fy"]:.9g}; adjust the camera with tie = [["fx", "fy"]]'
        )
    return p["fx"]


def size_of(camera: Camera, format: str) -> tuple[int, int]:
    """The image size of a camera.

    **Raises:** `InputError` without one."""
    if camera.image_size is None:
        raise InputError(f"camera {camera.id!r}: {format} needs the image size; give image_size")
    return camera.image_size
