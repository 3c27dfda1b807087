"""Camera files: which files hold cameras, and how cameras are written without a network.

| file | read | written |
|---|---|---|
| `.yaml`, `.yml`, `.json` of OpenCV | its camera | one, of model `opencv` or `kannala-brandt` |
| `.toml` with `[[camera]]` entries, a project file among them | its cameras | all cameras |
| `cameras.txt`, `cameras.bin` of COLMAP | its cameras | all, as `cameras.txt` |
| `camera_models.json` of OpenSfM | its cameras | all |
| `AutoCal….xml` of MicMac | its camera | one, of model `opencv`, `brown`, `brown-projected` |
| any input of `jaxbundle adjust` | its cameras | |
"""

from collections.abc import Sequence
from pathlib import Path

from jaxbundle.cameras import CameraModel
from jaxbundle.errors import InputError
from jaxbundle.io.cameras.opencv_file import is_opencv, read_opencv
from jaxbundle.io.networks.colmap import read_colmap_cameras
from jaxbundle.io.networks.column_map import is_column_map
from jaxbundle.io.networks.micmac_camera import is_autocal, read_autocal
from jaxbundle.io.networks.opensfm import is_opensfm_cameras, read_opensfm_cameras
from jaxbundle.io.networks.project import cameras_text
from jaxbundle.io.text.csv_tables import read_toml, write_text
from jaxbundle.network.build import make_cameras
from jaxbundle.network.columns import did_you_mean
from jaxbundle.network.tables import Camera

COLMAP_FILES = ("cameras.txt", "cameras.bin")
LOOKS = (
    "OpenCV's or ROS's .yaml, .yml or .json; a .toml with [[camera]] entries; cameras.txt or "
    "cameras.bin of COLMAP; camera_models.json of OpenSfM; AutoCal….xml of MicMac"
)
"""Description of camera files."""


def is_camera_file(path: Path) -> bool:
    """Whether a file holds only cameras."""
    if path.name.lower() in COLMAP_FILES and path.is_file():
        return True
    # a project and a column map are TOML with cameras too, but hold a network
    if _is_toml(path):
        return not is_column_map(path) and "project" not in read_toml(path)
    return is_opencv(path) or is_opensfm_cameras(path) or is_autocal(path)


def read_cameras(path: str | Path, models: Sequence[CameraModel] = ()) -> tuple[Camera, ...]:
    """The cameras of a camera file or a project file; `models`: own ones a .toml may name.

    **Raises:** `InputError`.
    """
    path = Path(path)
    if not path.is_file():
        raise InputError(f"{path}: no such file")
    if path.name.lower() in COLMAP_FILES:
        cameras = read_colmap_cameras(path)
        if not cameras:
            raise InputError(f"{path}: there is no camera in it")
        return cameras
    if _is_toml(path):
        cameras = read_toml(path).get("camera", [])
        if not isinstance(cameras, list) or not all(isinstance(c, dict) for c in cameras):
            raise InputError(f"{path}: write [[camera]] in double brackets, one for each camera")
        return make_cameras(cameras, f"{path}, ", models)
    if is_opensfm_cameras(path):
        return read_opensfm_cameras(path)
    return (read_autocal(path) if is_autocal(path) else read_opencv(path),)


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
