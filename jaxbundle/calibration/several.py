"""Several cameras calibrated from one board: separately, and as a rig if they are mounted."""

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from jaxbundle.calibration.calibrate import calibrate
from jaxbundle.calibration.each_camera import calibrate_each
from jaxbundle.calibration.result import Calibration
from jaxbundle.calibration.rig.calibrate import SHARED, calibrate_rig
from jaxbundle.calibration.rig.result import RigCalibration
from jaxbundle.errors import InputError
from jaxbundle.measure.boards import Board
from jaxbundle.measure.views import BoardViews
from jaxbundle.results import TableMethods
from jaxbundle.types import Progress


@dataclasses.dataclass(frozen=True)
class Calibrations(TableMethods):
    """Calibrations by the name of the camera, and the rig, if any."""

    cameras: dict[str, Calibration]
    rig: RigCalibration | None = None

    @property
    def converged(self) -> bool:
        return all(calibration.converged for calibration in self.cameras.values())

    def to_dict(self, brief: bool = False) -> dict[str, Any]:
        """The result as plain dicts and numbers, as in JSON: of one camera, or of several by name,
        with their rig."""
        from jaxbundle.calibration.several_report import calibrations_dict

        return calibrations_dict(self, brief)

    def table(self) -> dict[str, np.ndarray]:
        """One row a parameter of a camera: columns camera, parameter, value, sigma."""
        tables = {name: calibration.table() for name, calibration in self.cameras.items()}
        rows = [len(columns["value"]) for columns in tables.values()]
        parameter_columns = {
            column: np.concatenate([columns[column] for columns in tables.values()])
            for column in ("parameter", "value", "sigma")
        }
        return {"camera": np.repeat(np.array([*tables], dtype=object), rows), **parameter_columns}

    def __str__(self) -> str:
        parts = [] if self.rig is None else [str(self.rig)]
        return "\n".join([*parts, *map(str, self.cameras.values())])

    def report(self) -> str:
        """The verdict on several cameras, the report of their rig, and those of all cameras."""
        return self._in_words([calibration.report() for calibration in self.cameras.values()])

    def summary(self) -> str:
        """The same without the reports of the adjustments: a page or two a camera."""
        from jaxbundle.calibration.report import summary

        return self._in_words([summary(calibration) for calibration in self.cameras.values()])

    def _in_words(self, of_cameras: Sequence[str]) -> str:
        from jaxbundle.calibration.rig.report import rig_text
        from jaxbundle.calibration.several_report import several_text

        parts = [] if len(self.cameras) == 1 else [several_text(self)]
        parts += [] if self.rig is None else [rig_text(self.rig)]
        return "\n\n".join([*parts, *of_cameras])


def calibrate_cameras(
    photographs: Mapping[str, Sequence[str | Path] | BoardViews],
    board: Board | None = None,
    *,
    rig: bool = False,
    progress: Progress | None = None,
    **options: Any,
) -> Calibrations:
    """Calibrate several cameras from photographs of one board.

    **Arguments:** `photographs` by the name of the camera; `rig`: rigidly mounted cameras with
    simultaneous photographs (`calibration.rig`), the first is the reference; epochs that contradict
    the mounting are excluded, then single points (`snooping`, also if the cameras were estimated
    robustly); with `snooping=None`, and not robustly, such epochs are only listed;
    `progress(stage, done, total)`: photographs searched, a stage for every camera; `options`: those
    of `calibrate`.

    **Raises:** `InputError`, `NotSolvedError`, naming the camera if there are several.
    """
    if isinstance(photographs, Mapping) and rig and len(photographs) < 2:
        raise InputError("a rig has at least two cameras: give --camera NAME=PATTERN for each")
    calibrate_one = lambda name, photographs_of_camera, tell: calibrate(
        photographs_of_camera, board, camera=name, progress=tell, **options
    )
    calibrations = calibrate_each(photographs, calibrate_one, progress)
    rig_calibration = None
    if rig and all(calibration.converged for calibration in calibrations.values()):
        shared_options = {name: options[name] for name in (*SHARED, "robust") if name in options}
        rig_calibration = calibrate_rig(calibrations, **shared_options)
    return Calibrations(calibrations, rig_calibration)
