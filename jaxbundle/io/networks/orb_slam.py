"""Two cameras of ORB-SLAM 3 in one YAML file.

    Camera1.fx …, Camera2.fx …    cameras (`cameras.slam_yaml`); or Camera.fx … and Camera2.fx …
    Stereo.T_c1_c2                4 × 4: x₁ = R·x₂ + t, from the second camera to the first; old
                                  files: Tlr, 3 × 4

Source: ORB-SLAM 3, Settings.cc: the inverse of Stereo.T_c1_c2 is the R, T of `cv::stereoRectify`.
"""

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from jaxbundle.errors import InputError
from jaxbundle.io.cameras.nearest_camera import fit_messages
from jaxbundle.io.cameras.opencv_file import matrix_of
from jaxbundle.io.cameras.slam_yaml import YAML, is_slam_yaml, orb_cameras, read_yaml_fields
from jaxbundle.io.networks.assemble import rig_network
from jaxbundle.io.networks.poses import check_rotations
from jaxbundle.io.text.known_keys import UnknownKeys
from jaxbundle.network.tables import Network
from jaxbundle.system.file_content import beginning

POSE_KEYS = ("Stereo.T_c1_c2", "Tlr")


def is_orb_slam_pair(path: Path) -> bool:
    """Whether a YAML file of ORB-SLAM has a second camera."""
    if path.suffix.lower() not in YAML or not is_slam_yaml(path):
        return False
    return re.search(rb"(?m)^\s*[\"']?Camera2\.fx", beginning(path, 1_000_000)) is not None


def read_orb_slam_pair(path: str | Path, overrides: Sequence[str] = ()) -> Network:
    """Both cameras, on one mounting if the file has it; nothing can be adjusted.

    **Raises:** `InputError` naming file and key.
    """
    path = Path(path)
    fields, unknown = read_yaml_fields(path), UnknownKeys()
    cameras = orb_cameras(path, fields, unknown)
    if len(cameras) != 2:
        raise InputError(f"{path}: expected Camera1.fx … and Camera2.fx …")
    key = next((key for key in POSE_KEYS if fields.document.get(key) is not None), None)
    R, t = np.full((3, 3), np.nan), np.full(3, np.nan)
    if key is not None:
        T = matrix_of(path, key, fields.document[key], None)
        if T.size not in (12, 16):
            raise InputError(f"{path}: {key} has {T.size} numbers; expected 4 × 4")
        T = T[:12].reshape(3, 4)
        check_rotations(T[:, :3], f"{path}: {key}")
        R, t = T[:, :3].T, -T[:, :3].T @ T[:, 3]
    messages = (*fit_messages(cameras), *unknown.messages())
    return rig_network(path, cameras, [np.eye(3), R], [np.zeros(3), t], overrides, messages)
