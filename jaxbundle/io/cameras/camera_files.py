"""Camera files: which files hold cameras, and how cameras are written without a network.

Reading: `CAMERA_FORMATS`, and any input of `jaxbundle adjust`. Written are a file of OpenCV, ROS,
mrcal or MicMac for one camera, of OpenSfM, COLMAP or a `.toml` for all (`io.formats.CAMERA_KINDS`).
"""

import dataclasses
from collections.abc import Callable, Sequence
from pathlib import Path

from jaxbundle.cameras import CameraModel
from jaxbundle.choices import CAMERA_INPUTS
from jaxbundle.errors import InputError
from jaxbundle.io.cameras.metashape_lens import is_metashape_lens, read_metashape_lens
from jaxbundle.io.cameras.opencv_file import READ_SUFFIXES, is_opencv, read_opencv
from jaxbundle.io.cameras.ros_ini import is_ros_ini, is_ros_ini_pair, read_ros_ini
from jaxbundle.io.cameras.slam_yaml import is_slam_yaml, read_slam_yaml
from jaxbundle.io.networks.anipose import is_anipose
from jaxbundle.io.networks.colmap import read_colmap_cameras
from jaxbundle.io.networks.column_map import is_column_map
from jaxbundle.io.networks.micmac_camera import is_autocal, read_autocal
from jaxbundle.io.networks.opencv_rigs import is_opencv_rig
from jaxbundle.io.networks.opensfm import is_opensfm_cameras, read_opensfm_cameras
from jaxbundle.io.networks.orb_slam import is_orb_slam_pair
from jaxbundle.io.networks.project import cameras_text
from jaxbundle.io.text.csv_tables import read_toml, write_text
from jaxbundle.network.build import make_cameras
from jaxbundle.network.columns import did_you_mean
from jaxbundle.network.tables import Camera

COLMAP_FILES = ("cameras.txt", "cameras.bin")


@dataclasses.dataclass(frozen=True)
class CameraFormat:
    """A kind of file with cameras only: how it is recognised, read, and described."""

    recognises: Callable[[Path], bool]
    read: Callable[[Path], Sequence[Camera]]
    looks: str


def _single_camera_reader(reader: Callable[[Path], Camera]) -> Callable[[Path], Sequence[Camera]]:
    return lambda path: (reader(path),)


def _is_colmap_cameras(path: Path) -> bool:
    return path.name.lower() in COLMAP_FILES and path.is_file()


def _is_toml_cameras(path: Path) -> bool:
    # A project and a column map are TOML with cameras too, but hold a network.
    if not _is_toml(path) or is_column_map(path) or is_anipose(path):
        return False
    return "project" not in read_toml(path)


# In the order of recognition: OpenCV's habits, which many programs share, come last.
CAMERA_FORMATS: dict[str, CameraFormat] = {
    "colmap-cameras": CameraFormat(
        _is_colmap_cameras, read_colmap_cameras, CAMERA_INPUTS["colmap-cameras"]
    ),
    "cameras": CameraFormat(
        _is_toml_cameras, lambda path: _read_toml_cameras(path), CAMERA_INPUTS["cameras"]
    ),
    "opensfm-cameras": CameraFormat(
        is_opensfm_cameras, read_opensfm_cameras, CAMERA_INPUTS["opensfm-cameras"]
    ),
    "autocal": CameraFormat(
        is_autocal, _single_camera_reader(read_autocal), CAMERA_INPUTS["autocal"]
    ),
    "metashape-lens": CameraFormat(
        is_metashape_lens,
        _single_camera_reader(read_metashape_lens),
        CAMERA_INPUTS["metashape-lens"],
    ),
    "ros-ini": CameraFormat(
        lambda path: is_ros_ini(path) and not is_ros_ini_pair(path),
        read_ros_ini,
        CAMERA_INPUTS["ros-ini"],
    ),
    "slam-yaml": CameraFormat(
        lambda path: is_slam_yaml(path) and not is_orb_slam_pair(path),
        _single_camera_reader(read_slam_yaml),
        CAMERA_INPUTS["slam-yaml"],
    ),
    "opencv": CameraFormat(
        lambda path: is_opencv(path) and not is_opencv_rig(path),
        _single_camera_reader(read_opencv),
        CAMERA_INPUTS["opencv"],
    ),
}


def is_camera_file(path: Path) -> bool:
    """Whether a file holds only cameras."""
    return any(kind.recognises(path) for kind in CAMERA_FORMATS.values())


def read_cameras(path: str | Path, models: Sequence[CameraModel] = ()) -> tuple[Camera, ...]:
    """The cameras of a camera file or a project file; `models`: own ones a .toml may name.

    **Raises:** `InputError`.
    """
    path = Path(path)
    if not path.is_file():
        raise InputError(f"{path}: no such file")
    if _is_toml(path) and not is_anipose(path):
        return _read_toml_cameras(path, models)
    kind = next((kind for kind in CAMERA_FORMATS.values() if kind.recognises(path)), None)
    if kind is None and path.suffix.lower() in READ_SUFFIXES:
        return (read_opencv(path),)  # says what is missing of a camera
    if kind is None:
        names = ", ".join(CAMERA_FORMATS)
        raise InputError(f"{path}: not recognised as a camera file; known formats: {names}")
    cameras = tuple(kind.read(path))
    if not cameras:
        raise InputError(f"{path}: there is no camera in it")
    return cameras


def _read_toml_cameras(path: Path, models: Sequence[CameraModel] = ()) -> tuple[Camera, ...]:
    cameras = read_toml(path).get("camera", [])
    if not isinstance(cameras, list) or not all(isinstance(c, dict) for c in cameras):
        raise InputError(f"{path}: write [[camera]] in double brackets, one for each camera")
    return make_cameras(cameras, f"{path}, ", models)


def write_cameras(cameras: Sequence[Camera], path: str | Path) -> None:
    """Write cameras as `[[camera]]` entries of a TOML file."""
    write_text(Path(path), cameras_text(cameras))


def choose_camera(cameras: Sequence[Camera], id: str | None, where: str) -> Camera:
    """The camera of this id, or the only one.

    **Raises:** `InputError` if there is none, or several and no id is given.
    """
    ids = [camera.id for camera in cameras]
    if id is None and len(cameras) == 1:
        return cameras[0]
    if id is None:
        raise InputError(f"{where}: {len(ids)} cameras ({', '.join(ids[:8])}); name one of them")
    if id not in ids:
        raise InputError(f"{where}: no camera {id!r}{did_you_mean(id, ids)}")
    return cameras[ids.index(id)]


def _is_toml(path: Path) -> bool:
    return path.suffix.lower() == ".toml" and path.is_file()
