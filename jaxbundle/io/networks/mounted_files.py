"""Cameras in files of their own, placed in a body: VINS-Fusion and EuRoC.

**VINS-Fusion**: a YAML file with `cam0_calib: FILE`, …, cameras of camodocal beside it
(`cameras.slam_yaml`), and `body_T_cam0`, …, 4 × 4, from the camera to the body.

**EuRoC**: a folder with `cam0/sensor.yaml`, …, each with `T_BS`, from the camera to the body.

The frame is that of the body: the first camera is not at the origin.

Source: VINS-Fusion, its example settings; Burri et al. (2016), The EuRoC micro aerial vehicle
datasets, IJRR 35(10).
"""

import dataclasses
import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float

from jaxbundle.errors import InputError
from jaxbundle.io.cameras.nearest_camera import fit_messages
from jaxbundle.io.cameras.opencv_file import matrix_of, read_entries, read_opencv
from jaxbundle.io.cameras.slam_yaml import (
    SETTINGS_OF_VINS,
    SIZE,
    YAML,
    read_slam_yaml,
    read_yaml_fields,
)
from jaxbundle.io.networks.assemble import rig_network
from jaxbundle.io.networks.kalibr import camera_number
from jaxbundle.io.networks.poses import check_rotations
from jaxbundle.io.text.known_keys import Keys, UnknownKeys
from jaxbundle.network.tables import Camera, Network
from jaxbundle.system.file_content import beginning

SENSOR, PLACE = "sensor.yaml", "T_BS"
CALIB = re.compile(r"cam(\d+)_calib")
BODY_KEYS = SETTINGS_OF_VINS | Keys(
    ("cam*_calib", "body_T_cam*"), dict.fromkeys(SIZE, "stands in the files of the cameras")
)


def is_vins(path: Path) -> bool:
    """Whether a YAML file names the files of cameras as VINS-Fusion does."""
    head = beginning(path, 100_000) if path.suffix.lower() in YAML else b""
    return re.search(rb"(?m)^\s*cam\d+_calib\s*:", head) is not None


def read_vins(path: str | Path, overrides: Sequence[str] = ()) -> Network:
    """The cameras of VINS-Fusion; nothing can be adjusted.

    **Raises:** `InputError` naming file and key."""
    path = Path(path)
    fields, unknown = read_yaml_fields(path), UnknownKeys()
    unknown.check(fields.document, BODY_KEYS, path)
    cameras, poses = [], []
    keys = sorted(
        filter(CALIB.fullmatch, fields.document),
        key=lambda key: camera_number(key.removesuffix("_calib")),
    )
    if not keys:  # within another object, or in another file of the same name
        raise InputError(f"{path}: cam0_calib is missing at the first level; it is expected there")
    # A monocular setting may still name the second camera, without its place.
    for key in keys[: fields.integer("num_of_cam", len(keys), 1)]:
        file = path.parent / fields.text(key)
        if not file.is_file():
            raise InputError(f"{path}: {key}: no such file {file}; expected it beside this one")
        number = key.removesuffix("_calib")
        camera = read_slam_yaml(file)
        cameras.append(dataclasses.replace(camera, id=number))
        poses.append(_from_body(path, f"body_T_{number}", fields.get(f"body_T_{number}")))
    return _mounted_network(path, cameras, poses, overrides, unknown.messages())


def is_euroc(path: Path) -> bool:
    """Whether a folder has cameras in folders of their own, as EuRoC's `mav0`."""
    return path.is_dir() and any(path.glob(f"cam*/{SENSOR}"))


def read_euroc(path: str | Path, overrides: Sequence[str] = ()) -> Network:
    """The cameras of a folder of EuRoC; nothing can be adjusted.

    **Raises:** `InputError` naming file and key."""
    path = Path(path)
    files = sorted(
        path.glob(f"cam*/{SENSOR}"), key=lambda file: (camera_number(file.parent.name), file)
    )
    if not files:
        raise InputError(f"{path}: there is no cam0/{SENSOR} in it")
    cameras = [read_opencv(file) for file in files]
    poses = [_from_body(file, PLACE, read_entries(file).get(PLACE)) for file in files]
    return _mounted_network(path, cameras, poses, overrides)


Pose = tuple[Float[np.ndarray, "3 3"], Float[np.ndarray, "3"]]


def _from_body(path: Path, key: str, value: object) -> Pose:
    """R, t of x = R·X + t from X_body = T·x; NaN without it."""
    if value is None:
        return np.full((3, 3), np.nan), np.full(3, np.nan)
    T = matrix_of(path, key, value, None)
    if T.size != 16:
        raise InputError(f"{path}: {key} has {T.size} numbers; expected 4 × 4")
    T = T.reshape(4, 4)
    check_rotations(T[:3, :3], f"{path}: {key}")
    return T[:3, :3].T, -T[:3, :3].T @ T[:3, 3]


def _mounted_network(
    path: Path,
    cameras: Sequence[Camera],
    poses: Sequence[Pose],
    overrides: Sequence[str],
    messages: Sequence[str] = (),
) -> Network:
    rotations, shifts = zip(*poses)
    return rig_network(
        path, cameras, rotations, shifts, overrides, (*fit_messages(cameras), *messages)
    )
