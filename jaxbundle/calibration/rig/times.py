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
    calibrations: Mapping[str, Calibration], times: Any
) -> dict[str, dict[str, float]]:
    """Seconds by camera and name of the photograph, of those in which something was found.

    **Arguments:** `times`: frames per second, of all cameras or by camera; by camera seconds by
    the name of the photograph; or the path of a table with columns camera (or video), image, time.
    At a number of frames per second the last number in the name of a photograph is that of the
    frame.

    **Raises:** `InputError`."""
    if isinstance(times, str | Path):
        times = _read_times(Path(times))
    if isinstance(times, Mapping):
        for name in times:
            if name not in calibrations:
                suggestion = did_you_mean(str(name), calibrations)
                raise InputError(f"times: no camera {name!r} is given{suggestion}")
        missing_camera = next((name for name in calibrations if name not in times), None)
        if missing_camera is not None:
            raise InputError(f"times: nothing is given of camera {missing_camera!r}; {HOW}")
    times_found = {}
    for name, calibration in calibrations.items():
        times_of_camera = times[name] if isinstance(times, Mapping) else times
        times_found[name] = _times_of_camera(
            name, list(dict.fromkeys(calibration.views.photographs)), times_of_camera
        )
    return times_found


def _times_of_camera(camera: str, photographs: list[str], times: Any) -> dict[str, float]:
    if isinstance(times, Mapping):
        seconds_of = {}
        for photograph in photographs:
            # Tables of frames have names of files, photographs may have folders before theirs.
            key = photograph if photograph in times else Path(photograph).name
            if key not in times:
                suggestion = did_you_mean(key, [str(k) for k in times])
                raise InputError(f"times of camera {camera!r}: none of {key!r}{suggestion}")
            seconds_of[photograph] = _seconds(camera, key, times[key])
    else:
        # True is an int of Python, and 1 frame per second would be a surprise
        is_rate = isinstance(times, int | float | np.number) and not isinstance(times, bool)
        if not (is_rate and 0 < times < np.inf):
            raise InputError(f"times of camera {camera!r}: got {show(times)}; {HOW}")
        seconds_of = {name: _number(camera, name) / float(times) for name in photographs}
    # Two poses of one target at one instant contradict each other: IMG_7 beside copies of it, or
    # numbers that begin again in another folder.
    seconds, count = np.unique([*seconds_of.values()], return_counts=True)
    if (count > 1).any():
        repeated = float(seconds[count > 1][0])
        names = " and ".join([name for name, t in seconds_of.items() if t == repeated][:2])
        raise InputError(
            f"times of camera {camera!r}: {names} both have {repeated:g} s; expected a time of its "
            "own for each photograph"
        )
    return seconds_of


def _seconds(camera: str, photograph: str, value_given: Any) -> float:
    try:
        value = float(value_given)
    except (TypeError, ValueError):
        value = np.nan
    if not np.isfinite(value):
        raise InputError(
            f"times of camera {camera!r}: of {photograph!r} it is {show(value_given)}; expected "
            "seconds"
        )
    return value


def _number(camera: str, photograph: str) -> int:
    numbers = re.findall(r"\d+", Path(photograph).stem)
    if not numbers:
        raise InputError(
            f"times of camera {camera!r}: {photograph!r} has no number of a frame in its name; "
            f"{HOW}"
        )
    return int(numbers[-1])


def _read_times(path: Path) -> dict[str, dict[str, float]]:
    """The table of a file."""
    table: Columns = read_csv(path)
    # `jaxbundle frames` writes the folder of a video, which names its camera
    camera = "camera" if "camera" in table.values else "video"
    columns = [table.column(name) for name in (camera, "image", "time")]
    times: dict[str, dict[str, float]] = {}
    for name, image, time in zip(*columns):
        times_of_camera = times.setdefault(str(name), {})
        if str(image) in times_of_camera:
            raise InputError(f"{path}: image {image!r} of camera {name!r} is there twice")
        times_of_camera[str(image)] = _seconds(str(name), str(image), time)
    return times
