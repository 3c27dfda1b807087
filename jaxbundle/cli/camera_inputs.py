"""Shared by the camera commands: cameras of files, pairs of numbers, figures."""

import sys
from collections.abc import Callable
from pathlib import Path

from jaxbundle.adjustment.quality.expected_difference import Covariance
from jaxbundle.commands.cameras import open_calibration
from jaxbundle.errors import InputError
from jaxbundle.io.cameras.nearest_camera import fit_messages
from jaxbundle.io.text.csv_tables import write_bytes
from jaxbundle.network.tables import Camera


def calibration_given(
    text: str, image_size: tuple[float, float] | None = None
) -> tuple[Camera, Covariance | None]:
    """The camera of FILE or FILE#ID, with its covariance where the file has it; a warning if its
    model was fitted to another program's.

    **Raises:** `InputError`.
    """
    camera, covariance = open_calibration(text, image_size)
    for message in fit_messages([camera]):
        print(f"warning: {message}", file=sys.stderr)
    return camera, covariance


def pair(option: str, text: str) -> tuple[float, float] | None:
    """Two numbers A,B of an option; None if it is not given.

    **Raises:** `InputError`.
    """
    if not text:
        return None
    try:
        x, y = (float(word) for word in text.split(","))
    except ValueError:
        raise InputError(f"{option} {text}: expected two numbers A,B") from None
    return x, y


def write_png(path: Path, size: tuple[float, float], draw: Callable) -> None:
    """Write a figure; `draw` receives its axes.

    **Raises:** `InputError` without matplotlib.
    """
    from jaxbundle.plotting.files import png

    try:
        write_bytes(path, png(size, None, draw))
    except ImportError as error:
        raise InputError(str(error)) from None
