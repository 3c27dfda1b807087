"""Several cameras in one YAML, JSON or XML file in OpenCV's style, with their poses.

    K1, D1, K2, D2, R, T               of `stereoCalibrate`: X₂ = R·X₁ + T; also M1, cameraMatrix1,
                                       camera_matrix_left, left_camera_matrix, LEFT.K, …
    left: {K, D}, right: {K, D}, R, T  the same with an object a camera
    cam0: {K, D, R, T}, …              of any number of cameras: X = R·X_world + T of each, R a
                                       matrix or a rotation vector; or a matrix 4 × 4

Frames have x right, y down, z forward; the first pixel has its centre at 0. Entries of a camera are
spelled as in `cameras.spellings`. Without R and T the poses are unknown.

Source: OpenCV 4 documentation, calib3d.
"""

import dataclasses
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from jaxbundle.errors import InputError
from jaxbundle.io.cameras.nearest_camera import fit_messages
from jaxbundle.io.cameras.opencv_file import (
    LARGEST_FILE,
    READ_SUFFIXES,
    camera_of,
    find_cameras,
    matrix_of,
    read_document,
)
from jaxbundle.io.cameras.slam_yaml import is_slam_yaml
from jaxbundle.io.cameras.spellings import (
    IGNORED,
    EntriesByMeaning,
    camera_entries,
    cameras_within,
    fold,
    is_matrix,
    meaning_of,
)
from jaxbundle.io.networks.assemble import rig_network, unique_labels
from jaxbundle.io.networks.poses import check_rotations, matrices_of_rotation_vectors
from jaxbundle.io.text.known_keys import Keys, UnknownKeys
from jaxbundle.network.columns import count
from jaxbundle.network.tables import Camera, Network
from jaxbundle.system.file_content import beginning, is_plain

# Endings, or beginnings, of the names of the entries of two cameras.
SIDES = (("1", "2"), ("0", "1"), ("left", "right"), ("l", "r"), ("a", "b"))
ROTATION = "r rotation rotationmatrix rot rmat stereor rotationvector rvec rotationlefttoright om"
TRANSLATION = "t translation translationvector trans tvec transvec stereot translationlefttoright"
POSE = "transform transformation transformmatrix extrinsicmatrix extrinsics extrinsic pose rt"
POSES = {
    **dict.fromkeys(ROTATION.split(), "R"),
    **dict.fromkeys(TRANSLATION.split(), "T"),
    **dict.fromkeys(POSE.split(), "pose"),
}
# Entries that stand once for both cameras.
SHARED = (
    "image_size",
    "image_width",
    "image_height",
    "distortion_model",
    "camera_model",
    "fisheye_model",
)
UNKNOWN = np.full((3, 3), np.nan), np.full(3, np.nan)
RECTIFIED = Keys((), {
    **IGNORED.ignored,
    **dict.fromkeys(("r1", "r2", "p1", "p2", "q", "r*", "p*", "rectification*", "projection*"),
                    "the rectification, which follows from R and T"),
})  # fmt: skip


class CameraFromRig(NamedTuple):
    """x = R·X + t."""

    R: Float[np.ndarray, "3 3"]
    t: Float[np.ndarray, "3"]


def is_opencv_rig(path: Path) -> bool:
    """Whether a file has the entries of two cameras or more."""
    # ORB-SLAM's LEFT.K, RIGHT.K stand beside the camera of the rectified images
    if is_slam_yaml(path):
        return False
    cameras = find_cameras(path)
    if len(cameras) > 1:
        return True
    if cameras and cameras[0][1]:
        return _sides(cameras[0][1]) is not None  # {K: …, K1: …} is none
    return _is_pair(path)


def _is_pair(path: Path) -> bool:
    if path.suffix.lower() not in READ_SUFFIXES or not is_plain(path):
        return False
    head = beginning(path, 1_000_000)
    # The second side of each of the `SIDES`, at the beginning or the end of a name.
    if path.stat().st_size > LARGEST_FILE or not re.search(
        rb"(?i)\w(2|1|r|right|b)\b|\b(2|1|r|right|b)[_.]?\w", head
    ):
        return False
    try:
        document = read_document(path)
    except InputError:
        # A damaged file of this kind is reported by its reader.
        return re.search(rb"(?m)^\s*\"?[MK]1\"?\s*:", head) is not None
    return isinstance(document, Mapping) and _sides(document) is not None


def _sides(document: Mapping[str, Any]) -> tuple[str, str] | None:
    """The two sides by which the matrices of a pair are named."""
    for pair in SIDES:
        kinds = [
            {
                kind
                for name, value in document.items()
                if (kind := _meaning_on_side(name, value, side)) == "camera_matrix"
                and is_matrix(value)
            }
            for side in pair
        ]
        if all(kinds):
            return pair
    return None


def _name_without_side(name: str, side: str) -> str | None:
    """The name of an entry without its side."""
    folded_name = fold(name)
    if folded_name.endswith(side) and folded_name != side:
        return folded_name.removesuffix(side)
    return (
        folded_name.removeprefix(side)
        if folded_name.startswith(side) and folded_name != side
        else None
    )


def _meaning_on_side(name: str, value: Any, side: str) -> str | None:
    """What an entry is of the camera of a side."""
    base = _name_without_side(name, side)
    if base is None or (isinstance(value, int | float) and base in ("k", "p", "s")):
        return None
    return meaning_of(base, value)


def read_opencv_rig(path: str | Path, overrides: Sequence[str] = ()) -> Network:
    """The cameras of a file, each with an image; nothing can be adjusted.

    **Raises:** `InputError` naming file and entry.
    """
    path = Path(path)
    document, unknown = read_document(path), UnknownKeys()
    pair = _sides(document) if isinstance(document, Mapping) else None
    if pair is not None:
        cameras, poses = _read_pair(path, document, pair, unknown)
    else:
        cameras, poses = _read_nested(path, document, unknown)
    messages = (*fit_messages(cameras), *unknown.messages())
    R, t = zip(*poses)
    # The unit is that of the board, which the file does not say.
    return rig_network(path, cameras, R, t, overrides, messages, unit="model")


def _read_pair(
    path: Path, document: Mapping[str, Any], pair: tuple[str, str], unknown: UnknownKeys
) -> tuple[list[Camera], list[CameraFromRig]]:
    """Two cameras whose entries are told apart by their names."""
    side_entries: list[dict[str, Any]] = [{}, {}]
    common_entries: dict[str, Any] = {}
    for name, value in document.items():
        sides = [_meaning_on_side(name, value, side) for side in pair]
        # `distCoeffsL`: of one side; `R1`, `P1`: of the rectification
        if fold(name) in POSES or meaning_of(name, value) in SHARED or not any(sides):
            common_entries[name] = value
        else:
            side_entries[sides.index(next(filter(None, sides)))][name] = value
    shared = camera_entries(
        {k: v for k, v in common_entries.items() if meaning_of(k, v) in SHARED}, path, unknown
    )
    other_entries = {k: v for k, v in common_entries.items() if meaning_of(k, v) not in SHARED}
    pose = _take_pose(path, other_entries)
    name_by_folded = {fold(name): name for name in other_entries}
    unknown.check(
        (name_by_folded[name] for name in RECTIFIED.unknown(name_by_folded)), Keys(POSES), path
    )
    cameras = []
    for k, (side, entries) in enumerate(zip(pair, side_entries)):
        by_meaning: EntriesByMeaning = dict(shared)
        for name, value in entries.items():
            by_meaning[str(_meaning_on_side(name, value, side))] = (name, value)
        id = by_meaning.pop("camera_name", ("", side if len(side) > 1 else ("left", "right")[k]))[1]
        cameras.append(camera_of(path, by_meaning, str(id)))
    return cameras, [CameraFromRig(np.eye(3), np.zeros(3)), pose or CameraFromRig(*UNKNOWN)]


def _read_nested(
    path: Path, document: Any, unknown: UnknownKeys
) -> tuple[list[Camera], list[CameraFromRig]]:
    """Cameras that are objects of their own."""
    named_cameras = list(cameras_within(document))
    if len(named_cameras) < 2:
        raise InputError(
            f"{path}: {count(len(named_cameras), 'camera')} in it; expected two or more"
        )
    cameras, poses = [], []
    for k, (name, entries) in enumerate(named_cameras):
        where, lens_entries = f"{path}, {name}", dict(entries)
        poses.append(_take_pose(where, lens_entries))
        by_meaning = camera_entries(lens_entries, where, unknown)
        id = str(by_meaning.get("camera_name", ("", name or k))[1])
        cameras.append(camera_of(where, by_meaning, id))
    ids = [camera.id for camera in cameras]
    if len({*ids}) < len(ids):
        names = unique_labels([name for name, _ in named_cameras], range(len(named_cameras)))
        cameras = [dataclasses.replace(camera, id=name) for camera, name in zip(cameras, names)]
    if isinstance(document, Mapping):
        names = {name for name, _ in named_cameras}
        other_entries = {key: value for key, value in document.items() if key not in names}
        shared = (
            _take_pose(path, other_entries) if len(named_cameras) == 2 and not any(poses) else None
        )
        if shared is not None:
            poses = [CameraFromRig(np.eye(3), np.zeros(3)), shared]
        other_keys = {
            fold(key): key
            for key, value in other_entries.items()
            if not _contains_camera(value, named_cameras)
        }
        unknown.check((other_keys[key] for key in RECTIFIED.unknown(other_keys)), Keys(POSES), path)
    # With the first as reference, which many files leave out.
    if any(poses[1:]) and poses[0] is None:
        poses[0] = CameraFromRig(np.eye(3), np.zeros(3))
    return cameras, [pose or CameraFromRig(*UNKNOWN) for pose in poses]


def _contains_camera(value: Any, named_cameras: Sequence[tuple[str, Any]]) -> bool:
    """Whether a value contains one of the cameras."""
    if any(value is entries for _, entries in named_cameras):
        return True
    parts = value.values() if isinstance(value, Mapping) else value
    return isinstance(value, Mapping | list) and any(
        _contains_camera(part, named_cameras) for part in parts if isinstance(part, Mapping | list)
    )


def _take_pose(where: object, entries: dict[str, Any]) -> CameraFromRig | None:
    """The pose among entries, which are removed; None without one.

    **Raises:** `InputError` for half a pose, and what is no rotation."""
    name_of_kind = {
        POSES[fold(name)]: name
        for name, value in entries.items()
        if fold(name) in POSES and value not in (None, [])
    }
    pose_entries = {kind: (name, entries.pop(name)) for kind, name in name_of_kind.items()}
    path = str(where)
    if (
        "pose" in pose_entries
        and isinstance(pose_entries["pose"][1], Mapping)
        and "data" not in pose_entries["pose"][1]
    ):
        return _take_pose(f"{where}, {pose_entries['pose'][0]}", dict(pose_entries["pose"][1]))
    if "pose" not in pose_entries and "T" in pose_entries and "R" not in pose_entries:
        pose_entries["pose"] = pose_entries.pop("T")  # T, 4 × 4
    if "pose" in pose_entries:
        name, value = pose_entries["pose"]
        T = matrix_of(path, name, value, None)
        if T.size not in (12, 16) or (T.size == 16 and (T[12:] != (0, 0, 0, 1)).any()):
            raise InputError(f"{where}: {name} is no pose; expected 4 × 4 numbers, or R and T")
        T = T[:12].reshape(3, 4)
        R, t = T[:, :3], T[:, 3]
    elif {"R", "T"} <= pose_entries.keys():
        name, value = pose_entries["R"]
        R, t = matrix_of(path, name, value, None), matrix_of(path, *pose_entries["T"], None)
        if R.size not in (3, 9) or t.size != 3:
            raise InputError(
                f"{where}: {name} and {pose_entries['T'][0]} have {R.size} and {t.size} numbers; "
                "expected 9, or 3 of a rotation vector, and 3"
            )
        R = R.reshape(3, 3) if R.size == 9 else matrices_of_rotation_vectors(R[None])[0]
    elif pose_entries:
        ((_, (name, _)),) = pose_entries.items()
        raise InputError(f"{where}: {name} without the other of R and T; expected both, or none")
    else:
        return None
    check_rotations(R, f"{where}: {name}")
    return CameraFromRig(R, t)
