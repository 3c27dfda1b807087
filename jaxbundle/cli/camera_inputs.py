"""Shared by the camera commands: FILE or FILE#ID, pairs of numbers, figures."""

import sys
from collections.abc import Callable
from pathlib import Path

from jaxbundle.adjustment.quality.calibration_difference import Covariance
from jaxbundle.errors import InputError
from jaxbundle.io import read_network
from jaxbundle.io.cameras.calibrated import is_result, read_calibrated
from jaxbundle.io.cameras.camera_files import LOOKS, choose_camera, is_camera_file, read_cameras
from jaxbundle.io.cameras.nearest_camera import fit_messages
from jaxbundle.io.formats import FORMATS, recognise_format
from jaxbundle.io.text.csv_tables import write_bytes
from jaxbundle.network.tables import Camera


def camera_given(text: str) -> Camera:
    """The camera of a file of cameras or of any network; several need their #ID.

    **Raises:** `InputError`.
    """
    return calibration_given(text)[0]


def calibration_given(text: str) -> tuple[Camera, Covariance | None]:
    """The camera of `camera_given`, with the covariance of its free parameters if it is from a JSON
    result.

    **Raises:** `InputError`.
    """
    file, mark, id = text.rpartition("#")
    if not mark or Path(text).exists():
        file, id = text, None
    path = Path(file)
    found = {}
    if is_result(path):
        results = read_calibrated(path)
        cameras, found = [camera for camera, _ in results], {c.id: C for c, C in results}
    elif is_camera_file(path):
        cameras = read_cameras(path)
    elif path.exists() and recognise_format(path) is None:
        raise InputError(
            f"{path}: not recognised; expected a camera file ({LOOKS}), the result.json "
            f"of calibrate or adjust, or a network ({', '.join(FORMATS)})"
        )
    else:
        cameras = read_network(path).cameras
    camera = choose_camera(cameras, id, f"{file} (FILE#ID)")
    for told in fit_messages([camera]):
        print(f"warning: {told}", file=sys.stderr)
    return camera, found.get(camera.id)


def pair(option: str, text: str) -> tuple[float, float] | None:
    """Two numbers A,B of an option; None if it is not given.

    **Raises:** `InputError`.
    """
    if not text:
        return None
    try:
        first, second = (float(word) for word in text.split(","))
    except ValueError:
        raise InputError(f"{option} {text}: two numbers A,B are expected") from None
    return first, second


def write_png(path: Path, size: tuple[float, float], draw: Callable) -> None:
    """Write a figure; `draw` receives its axes.

    **Raises:** `InputError` without matplotlib.
    """
    from jaxbundle.plotting.files import png

    try:
        write_bytes(path, png(size, None, draw))
    except ImportError as error:
        raise InputError(str(error)) from None
