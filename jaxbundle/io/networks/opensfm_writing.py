"""Writing reconstructions of OpenSfM; the form is in `opensfm.py`."""

import json
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from jaxbundle.errors import InputError
from jaxbundle.geometry.pose_conventions import cv_pose
from jaxbundle.io.networks.losses import (
    check_others_zero,
    describe_losses,
    losing,
    need_values,
    one_focal_length,
    size_of,
)
from jaxbundle.io.networks.opensfm import (
    HEAD,
    KINDS,
    MODELS,
    ONE_FOCAL_LENGTH,
    RECONSTRUCTION,
    TRACKS,
    TWO_FOCAL_LENGTHS,
)
from jaxbundle.io.networks.poses import matrices_of, rotation_vectors_of
from jaxbundle.io.text.csv_tables import write_text
from jaxbundle.io.writing.folders import replace_folder
from jaxbundle.network.kinds import Antennas
from jaxbundle.network.tables import Camera, Network

FILES = (RECONSTRUCTION, TRACKS, MODELS)


def write_opensfm(network: Network, folder: str | Path, force: bool = False) -> tuple[str, ...]:
    """Write a reconstruction, its tracks and its cameras into a folder.

    Cameras must be of model `opencv` or `kannala-brandt` and have an image size.

    **Arguments:** `force`: also replace a folder not written by this function.

    **Returns:** messages about what the format cannot hold.

    **Raises:** `InputError` where the folder may not or cannot be written
    (`jaxbundle.io.writing.folders`).
    """
    with replace_folder(folder, "write_opensfm", FILES, force) as new:
        return fill_opensfm(network, new)


def fill_opensfm(network: Network, folder: Path) -> tuple[str, ...]:
    """Write a reconstruction into an existing folder or a new one; as `write_opensfm`."""
    need_values(network)
    images, points = network.images, network.points
    cameras = {camera.id: _camera_fields(camera) for camera in network.cameras}
    R, t = cv_pose(matrices_of(images.angles), images.position)
    rotation_vectors = rotation_vectors_of(R)
    image_cameras = [network.cameras[c] for c in images.camera.tolist()]
    shots = {
        id: {"camera": camera.id, "rotation": v, "translation": translation}
        for id, camera, v, translation in zip(
            images.id, image_cameras, rotation_vectors.tolist(), t.tolist()
        )
    }
    # gps_position is the projection centre: antennas with a lever arm are not
    antenna_tables = [
        kind for kind in network.further if isinstance(kind, Antennas) and not kind.settings
    ]
    for antennas in antenna_tables:
        for id, X0, C in zip(antennas.image, antennas.position.tolist(), antennas.covariance):
            shots[id] |= {"gps_position": X0, "gps_dop": float(np.sqrt(np.trace(C) / 3))}
    scene = {
        "cameras": cameras,
        "shots": shots,
        "points": {
            id: {"coordinates": X, "color": colour}
            for id, X, colour in zip(
                points.id, points.position.tolist(), points.colour_or_grey().astype(float).tolist()
            )
        },
    }
    folder.mkdir(exist_ok=True)
    write_text(folder / RECONSTRUCTION, json.dumps([scene], indent=1) + "\n")
    write_text(folder / MODELS, json.dumps(cameras, indent=1) + "\n")
    write_text(
        folder / TRACKS, _track_lines(network, [c.image_size or (1, 1) for c in image_cameras])
    )
    return describe_losses(network, OPENSFM_LOSSES)


def _antennas_changed(network: Network) -> int:
    """How many antennas are not written, or with another covariance than they have."""
    antenna_tables = [kind for kind in network.further if isinstance(kind, Antennas)]
    return sum(
        len(antennas.image)
        if antennas.settings
        else sum(not _is_isotropic(C) for C in antennas.covariance)
        for antennas in antenna_tables
    )


def _is_isotropic(C: Float[np.ndarray, "3 3"]) -> bool:
    # 1e-12: a σ that is squared and extracted again is off by a few eps (2e-16)
    mean_variance = np.trace(C) / 3
    return bool((abs(C - mean_variance * np.eye(3)) <= 1e-12 * mean_variance).all())


# What it loses: antennas with a lever arm or drifts are no projection centres, and gps_dop is one σ
# for all axes.
OPENSFM_LOSSES = losing(
    "pixel sizes of cameras",
    partly={Antennas.TABLE: _antennas_changed},
)


def _track_lines(network: Network, sizes: Sequence[tuple[int, int]]) -> Iterable[str]:
    images, points, rays = network.images, network.points, network.observations
    for id in (*images.id, *points.id):
        if any(character in id for character in "\t\n\r"):
            raise InputError(f"{TRACKS}: {id!r}: names of images and points cannot have tabs")
    yield f"{HEAD}2\n"
    for k, (i, p, (u, v)) in enumerate(
        zip(rays.image.tolist(), rays.point.tolist(), rays.xy.tolist())
    ):
        (w, h), s = sizes[i], max(sizes[i])
        x, y = (u - (w - 1) / 2) / s, (v - (h - 1) / 2) / s
        yield (
            f"{images.id[i]}\t{points.id[p]}\t{k}\t{x!r}\t{y!r}\t{1 / s!r}\t128\t128\t128\t-1\t-1\n"
        )


def write_opensfm_cameras(cameras: Sequence[Camera], path: str | Path) -> None:
    """Write cameras as `camera_models.json`."""
    fields = {camera.id: _camera_fields(camera) for camera in cameras}
    write_text(Path(path), json.dumps(fields, indent=1) + "\n")


def _camera_fields(camera: Camera) -> dict[str, Any]:
    """The fields of a camera, of the smallest kind that holds it."""
    kinds = {name: rest for name, (model, *rest) in KINDS.items() if model == camera.model}
    all_coefficients = max((names for _, names in kinds.values()), key=len, default=())
    p = check_others_zero(camera, "OpenSfM", all_coefficients)
    w, h = size_of(camera, "OpenSfM")
    s = max(w, h)
    c = [(p["cx"] - (w - 1) / 2) / s, (p["cy"] - (h - 1) / 2) / s]
    centred = c == [0, 0] and p["fx"] == p["fy"]
    name = next(
        name
        for name, (focal, names) in kinds.items()
        if (centred or focal == TWO_FOCAL_LENGTHS)
        and not any(p[k] for k in all_coefficients if k not in names)
    )
    focal, names = kinds[name]
    fields = {"projection_type": name, "width": w, "height": h}
    if focal == ONE_FOCAL_LENGTH:
        fields["focal"] = one_focal_length(camera, "OpenSfM") / s
    else:
        fields |= {"focal_x": p["fx"] / s, "focal_y": p["fy"] / s, "c_x": c[0], "c_y": c[1]}
    return fields | {name: p[name] for name in names}
