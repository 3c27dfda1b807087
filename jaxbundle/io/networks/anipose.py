"""Calibrated cameras in one system in the TOML of anipose, Pose2Sim, FreeMoCap and caliscope.

    [cam_0]
    name = "left"
    size = [ 1920, 1080,]
    matrix = [ [ 1000.0, 0.0, 960.0,], [ 0.0, 1000.0, 540.0,], [ 0.0, 0.0, 1.0,],]
    distortions = [ k1, k2, p1, p2, k3,]     OpenCV's, from none to eight; of a fisheye k1 … k4
    rotation = [ 0.0, 0.0, 0.0,]             a rotation vector, R of x = R·X + t
    translation = [ 0.0, 0.0, 0.0,]          t
    fisheye = false

    [metadata]                               of the calibration, not read

Frames have x right, y down, z forward; the centre of the first pixel is (0, 0). The unit of t is
that of the board: as a rule millimetres, metres in Pose2Sim. Written are the cameras in the frame
of the first.

Source: aniposelib, cameras.py; Pose2Sim, calibration.py.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from jaxbundle.errors import InputError
from jaxbundle.io.networks.assemble import rig_network, unique_labels
from jaxbundle.io.networks.kalibr import CORE, EQUI, RADTAN, mounted_losses, mountings_of
from jaxbundle.io.networks.losses import check_others_zero, describe_losses, size_of
from jaxbundle.io.networks.poses import matrices_of_rotation_vectors, rotation_vectors_of
from jaxbundle.io.text.csv_tables import read_toml, write_text
from jaxbundle.io.text.json_fields import JsonFields
from jaxbundle.io.text.known_keys import Keys, UnknownKeys
from jaxbundle.io.text.sections import toml_text
from jaxbundle.network.tables import Camera, Network
from jaxbundle.system.file_content import beginning

# OpenCV's coefficients in its order.
OPENCV = (*RADTAN, "k3", "k4", "k5", "k6")
# How many of them OpenCV takes.
LENGTHS = (0, 4, 5, 8)
ROTATED = ("rotation_count",)
# Of a camera.
KEYS = Keys(
    ("name", "size", "matrix", "distortions", "rotation", "translation", "fisheye", *ROTATED),
    {
        "error": "the residuals of the calibration",
        "port": "the number of the camera on its computer",
        "cam_id": "the number of the camera on its computer",
        "exposure": "a setting of the camera",
        "ignore": "whether the program uses the camera",
        "grid_count": "how many photographs were used",
        "verified_resolutions": "image sizes that the camera can have",
    },
)
FILE = Keys((), {"metadata": "of the calibration"})


def is_anipose(path: Path) -> bool:
    """Whether a TOML file has cameras with matrix, distortions, rotation and translation."""
    if path.suffix.lower() != ".toml":
        return False
    head = beginning(path, 100_000)
    words = (b"matrix", b"distortions", b"rotation", b"translation")
    return all(any(line.startswith(word) for line in head.splitlines()) for word in words)


def read_anipose(path: str | Path, overrides: Sequence[str] = ()) -> Network:
    """The cameras of a file, each with an image; nothing can be adjusted.

    **Raises:** `InputError` naming file, camera and key.
    """
    path = Path(path)
    unknown, document = UnknownKeys(), read_toml(path)
    tables = {
        key: value
        for key, value in document.items()
        if isinstance(value, dict) and "matrix" in value
    }
    unknown.check((key for key in document if key not in tables), FILE, path)
    if not tables:
        raise InputError(f"{path}: there is no camera; expected [cam_0] with matrix, …")
    fields = [JsonFields(f"{path}, [{key}]", table) for key, table in tables.items()]
    for camera_fields in fields:
        unknown.check(camera_fields.document, KEYS, camera_fields.path)
    names = [camera_fields.text("name", key) for camera_fields, key in zip(fields, tables)]
    cameras = [
        _camera(id, camera_fields)
        for id, camera_fields in zip(unique_labels(names, [*tables]), fields, strict=True)
    ]
    poses = [_pose(camera_fields) for camera_fields in fields]
    R, t = zip(*poses)
    return rig_network(path, cameras, R, t, overrides, unknown.messages(), unit="model")


def _camera(id: str, fields: JsonFields) -> Camera:
    K = fields.array("matrix", (3, 3))
    for row, column, expected in ((0, 1, 0), (1, 0, 0), (2, 0, 0), (2, 1, 0), (2, 2, 1)):
        if K[row, column] != expected:
            raise InputError(
                f"{fields.path}: matrix has {K[row, column]:g} in row {row + 1}, column "
                f"{column + 1}; expected {expected}"
            )
    if fields.get("rotation_count") not in (None, 0):
        raise InputError(
            f"{fields.path}: rotation_count {fields.get('rotation_count')}: the images are turned "
            "before they are used; turned images cannot be read"
        )
    fisheye = bool(fields.get("fisheye") or False)
    number = len(fields.get("distortions") or ())
    if number not in ((4,) if fisheye else LENGTHS):
        expected_count = "4" if fisheye else "none, 4, 5 or 8"
        raise InputError(
            f"{fields.path}: distortions has {number} numbers; expected {expected_count}"
        )
    values = fields.array("distortions", (number,)) if number else np.zeros(0)
    coefficients = dict(zip(EQUI if fisheye else OPENCV, values.tolist()))
    core = dict(zip(CORE, (K[0, 0], K[1, 1], K[0, 2], K[1, 2])))
    w, h = fields.array("size", (2,))
    size = JsonFields(f"{fields.path}: size", {"w": w, "h": h})
    return Camera(
        id,
        "kannala-brandt" if fisheye else "opencv",
        {name: float(value) for name, value in (core | coefficients).items()},
        image_size=(size.integer("w", minimum=1), size.integer("h", minimum=1)),
    )


def _pose(fields: JsonFields) -> tuple[np.ndarray, np.ndarray]:
    """R and t of a camera, NaN without them."""
    if fields.get("rotation") is None or fields.get("translation") is None:
        return np.full((3, 3), np.nan), np.full(3, np.nan)
    vector = fields.array("rotation", (3,))
    return matrices_of_rotation_vectors(vector[None])[0], fields.array("translation", (3,))


def write_anipose(network: Network, path: str | Path) -> tuple[str, ...]:
    """Write the cameras of a network, with the mountings of a rig, in the frame of the first.

    **Returns:** messages about what the format cannot hold.

    **Raises:** `InputError` for a camera of another model, with coefficients of distortion that the
    file cannot have, or without image size.
    """
    mountings, losses = mountings_of(network), []
    if mountings is None and len(network.cameras) > 1:
        losses.append("mountings of the cameras")
    document, pose = {}, np.eye(4)
    for k, camera in enumerate(network.cameras):
        if mountings is not None and k:
            pose = mountings[k - 1] @ pose
        section = _camera_section(camera)
        if mountings is not None or len(network.cameras) == 1:
            section["rotation"] = rotation_vectors_of(pose[None, :3, :3])[0].tolist()
            section["translation"] = pose[:3, 3].tolist()
        document[f"cam_{k}"] = section
    write_text(Path(path), toml_text(document | {"metadata": {"adjusted": True}}))
    return (*describe_losses(network, ANIPOSE_LOSSES), *losses)


def _camera_section(camera: Camera) -> dict[str, Any]:
    fisheye = camera.model == "kannala-brandt"
    p = check_others_zero(camera, "anipose", EQUI if fisheye else OPENCV)
    w, h = size_of(camera, "anipose")
    # Anipose itself reads five; the rational terms only where they are needed.
    number = 4 if fisheye else len(OPENCV) if any(p[name] for name in OPENCV[5:]) else 5
    names = (EQUI if fisheye else OPENCV)[:number]
    return {
        "name": camera.id,
        "size": [w, h],
        "matrix": [[p["fx"], 0.0, p["cx"]], [0.0, p["fy"], p["cy"]], [0.0, 0.0, 1.0]],
        "distortions": [p[name] for name in names],
        "fisheye": fisheye,
    }


# What it loses.
ANIPOSE_LOSSES = mounted_losses()
