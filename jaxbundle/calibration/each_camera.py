"""Cameras calibrated one by one, with errors that name the camera."""

from collections.abc import Callable, Mapping
from typing import Any

from jaxbundle.arguments import show
from jaxbundle.calibration.result import Calibration
from jaxbundle.errors import InputError, NotSolvedError
from jaxbundle.types import Progress


def calibrate_each(
    photographs: Mapping[str, Any],
    calibrate_one: Callable[[str, Any, Progress | None], Calibration],
    progress: Progress | None = None,
) -> dict[str, Calibration]:
    """The calibration of every camera, by its name.

    **Arguments:** `photographs` by the name of the camera; `calibrate_one(name, photographs,
    progress)`; `progress(stage, done, total)`, whose stage names the camera if there are several.

    **Raises:** `InputError`, `NotSolvedError`, naming the camera if there are several.
    """
    if not isinstance(photographs, Mapping) or not photographs:
        raise InputError(
            "photographs must be by the name of the camera, such as {'left': ['left/*.jpg']}, but "
            f"is {show(photographs)}"
        )
    calibrations = {}
    for name, photographs_of_camera in photographs.items():
        tell = (
            progress
            if progress is None or len(photographs) == 1
            else lambda stage, *numbers, name=name: progress(f"{stage} of {name}", *numbers)
        )
        try:
            calibrations[name] = calibrate_one(name, photographs_of_camera, tell)
        except (InputError, NotSolvedError) as error:
            if len(photographs) == 1:
                raise
            raise type(error)(f"camera {name}: {error}") from None
    return calibrations
