"""Networks from the contents of other programs' files, and helper functions for writers.

Readers give rotation matrices and numbers; here they become tables, with the settings of the
command line applied.
"""

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Num

from jaxbundle.cameras import default_parameters, get_model
from jaxbundle.geometry.pose_conventions import exterior_from_cv
from jaxbundle.io.networks.poses import angles_of
from jaxbundle.io.networks.settings import (
    SETTINGS,
    Document,
    apply_overrides,
    check_project_settings,
)
from jaxbundle.network.build import (
    OBSERVATION_COLUMNS,
    POINT_COLOURS,
    make_cameras,
    make_network,
)
from jaxbundle.network.columns import Columns, count, list_some
from jaxbundle.network.kinds import Rigs
from jaxbundle.network.rules import check_unique
from jaxbundle.network.tables import (
    EXTERIOR,
    GREY,
    Camera,
    Images,
    Network,
    Observations,
    Points,
    Source,
)
from jaxbundle.types import Column

# Coordinates of the centre of the first pixel in programs that count from its corner (COLMAP,
# nerfstudio, Metashape, PhotoModeler); here they are 0 (docs/conventions.md).
PIXEL_CENTRE = 0.5
# What programs write that have no colours: black, or grey as we do.
NO_COLOURS = ((0, 0, 0), GREY)
# The rig of a file of calibrated cameras, and its only epoch.
RIG, MOMENT = "rig", "0"


def foreign_document(
    name: str, cameras: Iterable[Mapping], **project: str | Sequence[str]
) -> Document:
    """The project document of a network of another program: measured in pixels, free."""
    settings = {
        "name": name,
        "datum": "inner",
        "image_unit": "px",
        "residuals": "measured",
        "object_unit": "model",
    }
    return {"project": settings | project, "camera": [dict(camera) for camera in cameras]}


def assemble(
    path: Path,
    document: Document,
    overrides: Sequence[str],
    images: Columns,
    points: Columns | None = None,
    observations: Columns | None = None,
    warnings: Iterable[str] = (),
) -> Network:
    """The network of a document and its tables, angles in radians.

    Without points the network has only cameras and images, and without image points it has only
    what else there is: both can be written but not adjusted. The image unit is that of the file and
    cannot be set.

    **Raises:** `InputError`.
    """
    keys = tuple(key for key in SETTINGS if key != "image_unit")
    document = apply_overrides(document, overrides, keys)
    project = dict(document["project"])
    check_project_settings(project, f"{path}: ")
    # The tables are in radians; the unit is one of the output.
    angle_unit = project.pop("angle_unit", "rad")
    cameras = make_cameras(document["camera"], f"{path}, ")
    if points is not None and len(points):
        if observations is None or not len(observations):
            columns: dict[str, Column] = {name: () for name in OBSERVATION_COLUMNS}
            observations = Columns(columns, Source(str(path), None, "image point"), True)
        network = make_network(cameras, images, points, observations, **project)
    else:
        network = _without_points(cameras, images, project)
    return network.replace(angle_unit=angle_unit).warn(*warnings)


def _without_points(cameras: Sequence[Camera], images: Columns, project: Mapping) -> Network:
    ids = images.ids("id")
    check_unique(ids, images.source, "image")
    index = {camera.id: c for c, camera in enumerate(cameras)}
    exterior = np.stack([images.numbers(name) for name in EXTERIOR], 1)
    no_indices = np.zeros(0, np.int64)
    # These settings concern observations and points, of which there are none.
    unused = ("sigma_image", "sigma_origin", "datum_points")
    settings = {k: v for k, v in project.items() if k not in unused}
    return Network(
        cameras=tuple(cameras),
        images=Images(
            ids,
            images.indices("camera", "camera", index, "cameras"),
            exterior[:, :3],
            exterior[:, 3:],
            np.full((len(ids), 6), np.nan),
            images.source,
        ),
        points=Points((), (), np.zeros((0, 3)), np.zeros((0, 3))),
        observations=Observations(no_indices, no_indices, np.zeros((0, 2)), np.zeros((0, 2))),
        **settings,
    )


def network_of_cameras(cameras: Sequence[Camera], where: str) -> Network:
    """Cameras with one image each, with the same names: a single one in its own frame, several
    without orientation, since nothing tells where they are."""
    names = [camera.id for camera in cameras]
    M = np.full((len(names), 3, 3), np.eye(3) if len(names) == 1 else np.nan)
    X0 = np.full((len(names), 3), 0.0 if len(names) == 1 else np.nan)
    images = image_columns(Source(where, None, "camera"), names, names, M, X0)
    project = {"datum": "inner", "residuals": "measured", "object_unit": "model"}
    return _without_points(cameras, images, project)


def rig_network(
    path: Path,
    cameras: Sequence[Camera],
    R: Sequence[Float[np.ndarray, "3 3"]],
    t: Sequence[Float[np.ndarray, "3"]],
    overrides: Sequence[str] = (),
    warnings: Iterable[str] = (),
    unit: str = "m",
) -> Network:
    """Cameras with one image each, of the same names, taken at one moment by a rig.

    `R`, `t`: x = R·X + t, the frame of a camera with x right, y down, z forward; NaN where a file
    does not have them. Images without a pose, and a single one with a pose among several cameras,
    have no orientation and are not part of the rig. Nothing can be adjusted.
    """
    names = [camera.id for camera in cameras]
    M, X0 = exterior_from_cv(np.stack(R), np.stack(t))
    has_pose = np.asarray(np.isfinite(np.concatenate([X0, M.reshape(-1, 9)], 1)).all(axis=1))
    if has_pose.sum() < 2 and len(names) > 1:
        # A pose relative to nothing.
        has_pose[:] = False
    M[~has_pose], X0[~has_pose] = np.nan, np.nan
    unposed = [name for name, is_posed in zip(names, has_pose) if not is_posed]
    if unposed and len(names) > 1:
        description = (
            f"{count(len(unposed), 'camera')} without a pose relative to another in the file"
        )
        warnings = (
            *warnings,
            f"{path}: {description}, left without orientation: {list_some(unposed)}",
        )
    source = Source(str(path), None, "camera")
    network = assemble(
        path,
        foreign_document(path.stem, map(entry_of, cameras), object_unit=unit),
        overrides,
        image_columns(source, names, names, M, X0),
        warnings=warnings,
    )
    mounted = [name for name, is_posed in zip(names, has_pose) if is_posed]
    if len(mounted) < 2:
        return network
    columns = {"rig": [RIG] * len(mounted), "epoch": [MOMENT] * len(mounted), "image": mounted}
    return network.replace(further=(Rigs.from_columns(Columns(columns, source), {}, 1.0),))


def unique_labels(labels: Sequence[str], ids: Sequence) -> list[str]:
    """The labels, repeated ones with their id."""
    number = Counter(labels)
    return [f"{label}#{id}" if number[label] > 1 else label for label, id in zip(labels, ids)]


def image_columns(
    source: Source,
    ids: Sequence,
    cameras: Sequence,
    M: Float[np.ndarray, "images 3 3"],
    X0: Float[np.ndarray, "images 3"],
) -> Columns:
    """The table of images from rotation matrices and projection centres."""
    values = np.concatenate([np.reshape(X0, (-1, 3)), angles_of(M)], 1)
    columns = {"id": ids, "camera": cameras, **dict(zip(EXTERIOR, values.T))}
    return Columns(columns, source)


def colour_columns(colours: Num[np.ndarray, "points 3"]) -> dict[str, np.ndarray]:
    """The columns of colours in a table of points, NaN where there is none; no columns if no
    point has one. They take no part in an adjustment: numbers that are no colours are rounded, and
    limited to 0 to 255."""
    colours = np.clip(np.rint(colours), 0, 255)
    if np.isnan(colours).all() or any((colours == no_colour).all() for no_colour in NO_COLOURS):
        return {}
    return dict(zip(POINT_COLOURS, colours.T))


def entry_of(camera: Camera) -> dict[str, Any]:
    """A camera as an entry of a document."""
    sizes = {"image_size": camera.image_size, "pixel_size": camera.pixel_size}
    tie = {"tie": camera.tie} if camera.tie else {}
    return {"id": camera.id, "model": camera.model, **sizes, **tie, **camera.parameters}


def all_parameters(camera: Camera) -> dict[str, float]:
    """All parameters of a camera by name, missing ones with their defaults."""
    values = {**default_parameters(get_model(camera.model)), **camera.parameters}
    return {name: float(values[name]) for name in get_model(camera.model).parameters}
