"""When photographs were taken, by the clock of their camera."""

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from jaxbundle.arguments import show
from jaxbundle.calibration.result import Calibration
from jaxbundle.errors import InputError
from jaxbundle.io.text.csv_tables import read_csv
from jaxbundle.network.columns import Columns, did_you_mean

HOW = (
    "expected frames per second (30), those of each camera ({'left': 30, 'right': 25}), seconds by "
    "the name of the photograph, or a CSV with the columns camera, image, time"
)


def times_of_photographs(
    calibrations: Mapping[str, Calibration], given: Any
) -> dict[str, dict[str, float]]:
    """Seconds by camera and name of the photograph, of those in which something was found.

    **Arguments:** `given`: frames per second, of all cameras or by camera; by camera seconds by
    the name of the photograph; or the path of a table with columns camera (or video), image, time.
    At a number of frames per second the last number in the name of a photograph is that of the
    frame.

    **Raises:** `InputError`."""
    if isinstance(given, str | Path):
        given = _read(Path(given))
    if isinstance(given, Mapping):
        for name in given:
            if name not in calibrations:
                known = did_you_mean(str(name), calibrations)
                raise InputError(f"times: no camera {name!r} is given{known}")
        missing = next((name for name in calibrations if name not in given), None)
        if missing is not None:
            raise InputError(f"times: nothing is given of camera {missing!r}; {HOW}")
    found = {}
    for name, one in calibrations.items():
        own = given[name] if isinstance(given, Mapping) else given
        found[name] = _of_camera(name, list(dict.fromkeys(one.views.photographs)), own)
    return found


def _of_camera(camera: str, photographs: list[str], given: Any) -> dict[str, float]:
    if isinstance(given, Mapping):
        found = {}
        for photograph in photographs:
            # Tables of frames have names of files, photographs may have folders before theirs.
            key = photograph if photograph in given else Path(photograph).name
            if key not in given:
                known = did_you_mean(key, [str(k) for k in given])
                raise InputError(f"times of camera {camera!r}: none of {key!r}{known}")
            found[photograph] = _seconds(camera, key, given[key])
    else:
        # True is an int of Python, and 1 frame per second would be a surprise
        good = isinstance(given, int | float | np.number) and not isinstance(given, bool)
        if not (good and 0 < given < np.inf):
            raise InputError(f"times of camera {camera!r}: got {show(given)}; {HOW}")
        found = {name: _number(camera, name) / float(given) for name in photographs}
    # Two poses of one target at one instant contradict each other: IMG_7 beside copies of it, or
    # numbers that begin again in another folder.
    seconds, count = np.unique([*found.values()], return_counts=True)
    if (count > 1).any():
        at = float(seconds[count > 1][0])
        names = " and ".join([name for name, t in found.items() if t == at][:2])
        raise InputError(
            f"times of camera {camera!r}: {names} both have {at:g} s; expected a time of its own "
            "for each photograph"
        )
    return found


def _seconds(camera: str, photograph: str, given: Any) -> float:
    try:
        value = float(given)
    except (TypeError, ValueError):
        value = np.nan
    if not np.isfinite(value):
        raise InputError(
            f"times of camera {camera!r}: of {photograph!r} it is {show(given)}; expected seconds"
        )
    return value


def _number(camera: str, photograph: str) -> int:
    found = re.findall(r"\d+", Path(photograph).stem)
    if not found:
        raise InputError(
            f"times of camera {camera!r}: {photograph!r} has no number of a frame in its name; "
            f"{HOW}"
        )
    return int(found[-1])


def _read(path: Path) -> dict[str, dict[str, float]]:
    """The table of a file."""
    table: Columns = read_csv(path)
    # `jaxbundle frames` writes the folder of a video, which names its camera
    camera = "camera" if "camera" in table.values else "video"
    columns = [table.column(name) for name in (camera, "image", "time")]
    found: dict[str, dict[str, float]] = {}
    for name, image, time in zip(*columns):
        own = found.setdefault(str(name), {})
        if str(image) in own:
            raise InputError(f"{path}: image {image!r} of camera {name!r} is there twice")
        own[str(image)] = _seconds(str(name), str(image), time)
    return found
