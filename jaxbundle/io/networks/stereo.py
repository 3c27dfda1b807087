"""Two cameras on one mounting, in the forms of OpenCV and of ROS. A rig of more cameras is written
as pairs, each camera with the first.

    X₂ = R·X₁ + T        frames with x right, y down, z forward; a first pixel with its centre at 0

**OpenCV** (`stereoCalibrate`, and its sample `stereo_calib`): one YAML or JSON file with M1, D1,
M2, D2, R, T, and of the rectification R1, R2, P1, P2, Q; of more cameras NAME_FIRST_CAMERA.yaml.

**ROS**: one `camera_info` file a camera, in a folder FIRST_CAMERA a pair if there are more cameras.
Its rectification_matrix Rₖ turns the camera into a frame common to both, and projection_matrix Pₖ
projects from the frame of the first,

    Xₖ' = Rₖ·Xₖ,    X₂' = X₁' + [P₁₄/P₁₁, P₂₄/P₂₂, 0]ᵀ of P₂,

from which R and T follow: R = R₂ᵀ·R₁, T = R₂ᵀ·[P₁₄/P₁₁, P₂₄/P₂₂, 0]ᵀ.

The rectified frame has one axis along the base, x, or y if the cameras are one above the other,
and z as near as possible to the mean of both axes (Fusiello, Trucco and Verri, 2000, Machine Vision
and Applications 12, 16–22). Both rectified cameras have the mean principal distance and the
mean principal point.

Source: OpenCV 4 documentation, calib3d; ROS, sensor_msgs/CameraInfo.
"""

import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from jaxbundle.errors import InputError
from jaxbundle.io.cameras.nearest_camera import fit_messages
from jaxbundle.io.cameras.opencv_file import YAML, matrix_in, read_entries, read_opencv
from jaxbundle.io.cameras.opencv_writing import file_text, opencv_entries, ros_text
from jaxbundle.io.cameras.ros_ini import is_ros_ini_pair, read_ros_sections
from jaxbundle.io.networks.assemble import all_parameters, rig_network
from jaxbundle.io.networks.kalibr import mounted_losses, mountings_of
from jaxbundle.io.networks.losses import describe_losses, mountings_in_metres, size_of
from jaxbundle.io.networks.poses import check_rotations
from jaxbundle.io.text.csv_tables import write_texts
from jaxbundle.network.tables import Camera, Network
from jaxbundle.system.file_content import beginning

ROS_FILES = ("*.yaml", "*/*.yaml")
RECTIFIED_ENTRIES = "rectification_matrix", "projection_matrix"
FISHEYE_ENTRIES = "fisheye_model", "distortion_model"
# Written names of matrices and coefficients; read ones are in `opencv_rigs`.
NAMES = ("M1", "D1", "M2", "D2")


class Rectification(NamedTuple):
    """Rotations of both cameras into the rectified frame, and their 3 × 4 projections."""

    R1: Float[np.ndarray, "3 3"]
    R2: Float[np.ndarray, "3 3"]
    P1: Float[np.ndarray, "3 4"]
    P2: Float[np.ndarray, "3 4"]

    @property
    def Q(self) -> Float[np.ndarray, "4 4"]:
        """Of [x, y, disparity, 1] the homogeneous point in the first rectified frame."""
        f, cx, cy = self.P1[0, 0], self.P1[0, 2], self.P1[1, 2]
        base = np.abs(self.P2[:2, 3]).argmax()
        return np.array(
            [
                [1, 0, 0, -cx],
                [0, 1, 0, -cy],
                [0, 0, 0, f],
                [0, 0, -f / self.P2[base, 3], 0],
            ]
        )


class StereoPair(NamedTuple):
    """Two cameras with X₂ = R·X₁ + T; `name` of its file, empty if there is no other pair."""

    cameras: tuple[Camera, Camera]
    R: Float[np.ndarray, "3 3"]
    T: Float[np.ndarray, "3"]
    name: str

    def __str__(self) -> str:
        return " and ".join(repr(camera.id) for camera in self.cameras)


def rectify(
    cameras: Sequence[Camera], R: Float[np.ndarray, "3 3"], T: Float[np.ndarray, "3"]
) -> Rectification:
    """The rectification of two cameras.

    **Raises:** `InputError` for cameras at one position, or without a common image plane."""
    length = float(np.linalg.norm(T))
    if length == 0:
        raise InputError("both cameras are at one position; expected a base between them")
    base = -R.T @ T / length  # from the first to the second, in the first's frame
    k = int(np.abs(base[:2]).argmax())  # the axis along the base, pointing as the camera's own
    base_axis = base * np.sign(base[k])
    axes = np.array([[0, 0, 1.0], R[2]])  # both optical axes, in the first's frame
    z = axes.sum(0)
    z = z - (z @ base_axis) * base_axis
    # Each optical axis needs an image in the common plane, so that it is less than 90° from z.
    # 1e-6, of unit vectors: rounding of a base along an axis, and of opposite axes.
    if not base_axis.any() or (axes @ z <= 1e-6).any():
        raise InputError(
            "one camera looks along the base or away from the other; they have no common "
            "rectified image"
        )
    z = z / np.linalg.norm(z)
    # Right-handed: x × y = z, whichever of both lies along the base.
    rows = [base_axis, np.cross(z, base_axis)] if k == 0 else [np.cross(base_axis, z), base_axis]
    R1 = np.stack([*rows, z])
    R2 = R1 @ R.T
    p = [all_parameters(camera) for camera in cameras]
    f = np.mean([values[name] for values in p for name in ("fx", "fy")])
    c = [np.mean([values[name] for values in p]) for name in ("cx", "cy")]
    P1 = np.array([[f, 0, c[0], 0], [0, f, c[1], 0], [0, 0, 1, 0]])
    P2 = P1.copy()
    P2[:, 3] = P1[:, :3] @ np.where(np.arange(3) == k, R2 @ T, 0)
    # The shift along z is zero, so that P[:, 3] has no part of the principal point.
    return Rectification(R1, R2, P1, P2)


def _file_names(cameras: Sequence[Camera]) -> list[str]:
    """A name of each camera for a file.

    **Raises:** `InputError` if two are equal."""
    names = [re.sub(r"[^\w.-]+", "_", camera.id) or "camera" for camera in cameras]
    # Some systems do not distinguish capital letters.
    folded_names = [name.casefold() for name in names]
    for k, name in enumerate(folded_names):
        if name in folded_names[:k]:
            equal_pair = f"{cameras[folded_names.index(name)].id!r} and {cameras[k].id!r}"
            raise InputError(
                f"the names of the cameras {equal_pair} give the same file {names[k]}.yaml"
            )
    return names


def _pairs(network: Network, format_name: str) -> list[StereoPair]:
    """Every camera with the first.

    **Raises:** `InputError` for a single camera, and for cameras without mountings."""
    cameras = network.cameras
    if len(cameras) < 2:
        raise InputError(f"{format_name} holds two cameras, got {len(cameras)}")
    mountings = mountings_of(network)
    if mountings is None:
        raise InputError(
            f"{format_name} holds the mounting of two cameras; expected a rig, or one image of each"
        )
    names, T, pairs = _file_names(cameras), np.eye(4), []
    for camera, name, step in zip(cameras[1:], names[1:], mountings):
        T = step @ T  # from the first camera to this one
        pair_name = f"{names[0]}_{name}" if len(cameras) > 2 else ""
        pairs.append(StereoPair((cameras[0], camera), T[:3, :3], T[:3, 3], pair_name))
    return pairs


# What both formats lose.
STEREO_LOSSES = mounted_losses()


def opencv_stereo_files(network: Network, path: Path) -> tuple[Path, ...]:
    """The file of each pair of a rig; of two cameras the path itself."""
    pairs = _pairs(network, "a stereo file of OpenCV")
    return tuple(_output_file(pair, path) for pair in pairs)


def _output_file(pair: StereoPair, path: Path) -> Path:
    return path.with_name(f"{path.stem}_{pair.name}{path.suffix}") if pair.name else path


def write_opencv_stereo(network: Network, path: str | Path) -> tuple[str, ...]:
    """Write two cameras and their mounting as OpenCV's stereo calibration; of a rig of more cameras
    one file a pair, NAME_FIRST_CAMERA.

    **Returns:** messages about what the format cannot hold.

    **Raises:** `InputError` for a network of one camera, or without a mounting.
    """
    path = Path(path)
    pairs = _pairs(network, "a stereo file of OpenCV")
    texts, losses = [], []
    for pair in pairs:
        entries = _stereo_entries(pair)
        try:
            rectified = rectify(*pair[:3])
        except InputError as error:
            losses.append(f"rectification of {pair}: {error}")
        else:
            entries |= {name: (*M.shape, M.ravel()) for name, M in rectified._asdict().items()}
            entries |= {"Q": (4, 4, rectified.Q.ravel())}
        texts.append(file_text(entries, path.suffix.lower() == ".json"))
    write_texts([_output_file(pair, path) for pair in pairs], texts)
    return (*describe_losses(network, STEREO_LOSSES), *losses)


def _stereo_entries(pair: StereoPair) -> dict[str, Any]:
    kinds = {str(camera.model) for camera in pair.cameras}
    if len(kinds) > 1:
        raise InputError(f"a stereo file of OpenCV has one camera model, got {', '.join(kinds)}")
    entries: dict[str, Any] = {}
    for k, camera in enumerate(pair.cameras, 1):
        camera_entries = opencv_entries(camera)
        names = NAMES[2 * k - 2 : 2 * k]
        w, h = size_of(camera, "OpenCV")
        entries |= {f"image_width_{k}": w, f"image_height_{k}": h, f"camera_name_{k}": camera.id}
        entries |= dict(
            zip(names, (camera_entries["camera_matrix"], camera_entries["distortion_coefficients"]))
        )
        entries |= {
            name: camera_entries[name] for name in FISHEYE_ENTRIES if name in camera_entries
        }
    return entries | {"R": (3, 3, pair.R.ravel()), "T": (3, 1, pair.T)}


def ros_stereo_folders(network: Network, folder: Path) -> tuple[Path, ...]:
    """The folder of each pair of a rig; of two cameras the folder itself."""
    pairs = _pairs(network, "a pair of ROS")
    return tuple(folder / pair.name for pair in pairs)


def fill_ros_stereo(network: Network, folder: Path) -> tuple[str, ...]:
    """Write two cameras as ROS's camera_info, NAME.yaml each, rectified with each other, in metres;
    of a rig of more cameras a folder FIRST_CAMERA a pair.

    **Returns, raises:** as `write_opencv_stereo`; `InputError` if no pair can be rectified.
    """
    network, losses = mountings_in_metres(network, "ros-stereo")
    pairs = _pairs(network, "a pair of ROS")
    texts, failures = {}, []
    for pair in pairs:
        try:
            rectified = rectify(*pair[:3])
        except InputError as error:
            failures.append(f"pair of {pair}: {error}")
            continue
        parts = ((rectified.R1, rectified.P1), (rectified.R2, rectified.P2))
        for camera, name, part in zip(pair.cameras, _file_names(pair.cameras), parts):
            texts[folder / pair.name / f"{name}.yaml"] = ros_text(camera, *part)
    if not texts:
        raise InputError("; ".join(failures))
    for file in texts:
        file.parent.mkdir(parents=True, exist_ok=True)
    write_texts([*texts], [*texts.values()])
    return (*describe_losses(network, STEREO_LOSSES), *losses, *failures)


def is_ros_stereo(path: Path) -> bool:
    """Whether a folder has two YAML files, each with a projection_matrix, or a text of
    camera_calibration has two cameras."""
    if not path.is_dir():
        return is_ros_ini_pair(path)
    files = _yaml_files(path)
    return len(files) == 2 and all(b"projection_matrix" in beginning(p, 100_000) for p in files)


def _yaml_files(folder: Path) -> list[Path]:
    return sorted(p for p in folder.iterdir() if p.suffix.lower() in YAML)


def _rectified_cameras(path: Path) -> Iterator[tuple[str, Camera, Mapping[str, Any]]]:
    """Places, cameras, and the entries that have R and P."""
    if not path.is_dir():
        for camera, section in read_ros_sections(path):
            names = dict(zip(RECTIFIED_ENTRIES, ("rectification", "projection")))
            entries = {key: section[name] for key, name in names.items() if name in section}
            yield f"{path}, [{camera.id}]", camera, entries
        return
    for file in _yaml_files(path):
        entries = read_entries(file)
        name = entries.get("camera_name")
        yield str(file), read_opencv(file, entries, str(name or file.stem)), entries


def read_ros_stereo(path: str | Path, overrides: Sequence[str] = ()) -> Network:
    """Both cameras of a folder of camera_info files, or of `ost.ini`; the first is the one whose
    projection has no shift. Nothing can be adjusted.

    **Raises:** `InputError` naming file and entry.
    """
    path = Path(path)
    parts = []
    for where, camera, entries in _rectified_cameras(path):
        R = matrix_in(where, entries, (RECTIFIED_ENTRIES[0], "R"), (3, 3))
        P = matrix_in(where, entries, (RECTIFIED_ENTRIES[1], "P"), (3, 4))
        check_rotations(R, f"{where}: rectification_matrix")
        if P[0, 0] == 0 or P[1, 1] == 0:
            raise InputError(f"{where}: projection_matrix has no focal length")
        shift = np.array([P[0, 3] / P[0, 0], P[1, 3] / P[1, 1], 0.0])
        parts.append((camera, R, shift))
    if len(parts) != 2:
        raise InputError(f"{path}: {len(parts)} cameras; expected two")
    # The one without a shift is the first, whatever the files are called.
    parts.sort(key=lambda part: bool(part[2].any()))
    (left, R1, left_shift), (right, R2, shift) = parts
    if left_shift.any() or not shift.any():
        raise InputError(
            f"{path}: expected the projection_matrix of one camera with and of the other without "
            f"a shift in its last column, got {'two' if left_shift.any() else 'none'} with"
        )
    rotations, translations = [np.eye(3), R2.T @ R1], [np.zeros(3), R2.T @ shift]
    return rig_network(
        path, [left, right], rotations, translations, overrides, fit_messages([left, right])
    )
