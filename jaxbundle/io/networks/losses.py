"""What a writer needs of a network, and what its format has no place for."""

import numpy as np

from jaxbundle.errors import InputError
from jaxbundle.network.tables import Network


def need_values(network: Network, model: str = "", format: str = "", points: bool = True) -> None:
    """Refuse a network without orientations, coordinates, or the only model a format has.

    **Raises:** `InputError` naming camera, image or point.
    """
    for camera in network.cameras:
        if model and camera.model != model:
            raise InputError(
                f"camera {camera.id!r}: {format} has no model {str(camera.model)!r}; convert it "
                f"with --model {model}"
            )
    images, given = network.images, network.points
    tables = [(images, images.position, "image", "orientation"),
              (images, images.angles, "image", "orientation"),
              (given, given.position, "point", "coordinates")]  # fmt: skip
    for table, values, thing, what in tables[: 3 if points else 2]:
        for row, *_ in np.argwhere(~np.isfinite(values))[:1]:
            raise InputError(
                f"{table.source(row)}: {thing} {table.id[row]!r} has no {what} to be written"
            )


def what_is_lost(
    network: Network, shared_cameras: bool = False, names: bool = False, rays: bool = False
) -> tuple[str, ...]:
    """What a network has that formats of computer vision have not, in words.

    **Arguments:** `shared_cameras` whether every image gets a camera of its own; `names` whether
    ids become numbers; `rays` whether image points are lost.
    """
    images, points = network.images, network.points
    found = {
        "roles and σ of control, fixed and check points": not points.has_role("tie").all(),
        "prior σ of exterior orientations": not np.isnan(images.sigma).all(),
        "σ of image points": len(np.unique(network.observations.sigma)) > 1,
        "distances": len(network.distances) > 0,
        **{one.TABLE: True for one in network.further},
        "that images share a camera": shared_cameras and len(network.cameras) < len(images),
        "names of images and points, which are numbered from 0":
            names and not _numbered(images.id, points.id),
        "image points": rays and len(network.observations) > 0,
    }  # fmt: skip
    return tuple(what for what, there in found.items() if there)


def _numbered(*ids) -> bool:
    return all(list(names) == [str(k) for k in range(len(names))] for names in ids)
