"""`hand_eye`: a camera on a robot, by a network or photographs and poses of the hand."""

import dataclasses
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from jaxbundle.adjustment.adjust import adjust
from jaxbundle.adjustment.result import Adjustment
from jaxbundle.calibration import calibrate
from jaxbundle.calibration.rig.motion import transformation
from jaxbundle.choices import HAND_EYE
from jaxbundle.display import print_in_one_screen
from jaxbundle.errors import InputError
from jaxbundle.geometry.quaternions import matrix_from_quaternion
from jaxbundle.io import read_network
from jaxbundle.io.results.result_project import readjustable_network
from jaxbundle.io.text.csv_tables import read_csv
from jaxbundle.measure.boards import Board
from jaxbundle.network.build import add_further
from jaxbundle.network.kinds.robot_poses import IN_HAND, PARTS, TABLES, RobotPoses
from jaxbundle.network.tables import Network
from jaxbundle.reconstruction.adjusting import WRONG_MISFIT
from jaxbundle.results import TableMethods


@print_in_one_screen
@dataclasses.dataclass(frozen=True)
class HandEye(TableMethods):
    """A camera on the hand of a robot, or before it; **Fields:** `adjustment`: the result of all
    observations, with everything it says."""

    adjustment: Adjustment

    @property
    def poses(self) -> RobotPoses:
        """The poses of the robot."""
        kinds = self.adjustment.problem.network.further
        return next(kind for kind in kinds if isinstance(kind, RobotPoses))

    def camera(self, name: str | None = None) -> Float[np.ndarray, "4 4"]:
        """Camera → hand (eye in hand) or camera → base (eye to hand): x' = T·x. The camera looks
        along −z, y up; `name`: of one of several cameras."""
        table = self.adjustment.unknowns(TABLES[self.poses.type].eye)
        row = self._row(name)
        M = np.asarray(matrix_from_quaternion(table.value.rotation[row]))
        return transformation(M.T, table.value.position[row])

    @property
    def cameras(self) -> list[str]:
        """The names of the cameras."""
        return [*self.adjustment.further_unknowns[TABLES[self.poses.type].eye]]

    def _row(self, name: str | None) -> int:
        labels = self.cameras
        if name is not None and name not in labels:
            raise InputError(f"camera is {name!r}; expected one of {', '.join(labels)}")
        return 0 if name is None else labels.index(name)

    @property
    def frame(self) -> Float[np.ndarray, "4 4"]:
        """Object space → base (eye in hand: robot–world), or object → hand (eye to hand)."""
        table = self.adjustment.unknowns(TABLES[self.poses.type].frame)
        M = np.asarray(matrix_from_quaternion(table.value.rotation[0]))
        return transformation(M, -M @ (table.value.position[0] + self.adjustment.problem.origin))

    def covariance(self, name: str | None = None) -> Float[np.ndarray, "6 6"]:
        """Of the position of the camera (object unit) and a small rotation about the axes of the
        camera (radians), a posteriori."""
        row = self._row(name)
        return self.adjustment.unknowns(TABLES[self.poses.type].eye).covariance[row]

    @property
    def repeatability(self) -> dict[str, float]:
        """σ of a position of the hand (object unit) and of its attitude (unit of angles), estimated
        from the residuals; of those given the median."""
        adjustment, repeatability = self.adjustment, {}
        for name, column in zip(PARTS, (0, 3)):
            if name in adjustment.sigma_factors:
                stated_sigma = float(np.median(self.poses.sigma[:, column : column + 3]))
                unit = adjustment.angle_scale if column else 1.0
                repeatability[name] = adjustment.sigma_factors[name] * stated_sigma * unit
        return repeatability

    @property
    def converged(self) -> bool:
        return self.adjustment.converged

    def table(self) -> dict[str, np.ndarray]:
        """A row for every number of the two poses: columns of, unknown, value, sigma."""
        rows = [
            (f"{table} {row}", name, estimate["value"], estimate["sigma"])
            for table in TABLES[self.poses.type]
            for row, numbers in self.adjustment.further_unknowns[table].items()
            for name, estimate in numbers.items()
        ]
        pose, unknown, value, sigma = zip(*rows)
        words = lambda x: np.array(x, dtype=object)
        return {
            "of": words(pose),
            "unknown": words(unknown),
            "value": np.array(value),
            "sigma": np.array(sigma),
        }

    def report(self) -> str:
        return f"{self}\n\n{self.adjustment.report()}"

    def to_dict(self) -> dict[str, Any]:
        """The transformations as matrices, every number with σ, and the result of the adjustment
        (`adjustment`)."""
        names = self.cameras
        return {
            "type": self.poses.type,
            "cameras": {name: self.camera(name).tolist() for name in names},
            "frame": self.frame.tolist(),
            "covariance": {name: self.covariance(name).tolist() for name in names},
            "repeatability": self.repeatability,
            "doubts": self.doubts,
            "unknowns": {
                table: self.adjustment.further_unknowns[table] for table in TABLES[self.poses.type]
            },
            "adjustment": self.adjustment.to_dict(),
        }

    def __str__(self) -> str:
        number, network = len(self.poses), self.adjustment.problem.network
        hand = self.poses.type == IN_HAND
        lines = [
            f"{self.poses.type}: {number} poses of the robot, σ0 {self.adjustment.sigma0:.3f}",
            f"camera in the {'hand' if hand else 'base'} and object space in the "
            f"{'base' if hand else 'hand'} ({network.object_unit}, {network.angle_unit}):",
        ]
        table = self.table()
        for pose, name, value, sigma in zip(*table.values()):
            lines.append(f"  {pose:28} {name:6} {value:14.6f}  σ {sigma:.2g}")
        for name, value in self.repeatability.items():
            unit = network.object_unit if name == "robot positions" else network.angle_unit
            lines.append(f"repeatability, {name}: σ {value:.3g} {unit}")
        return "\n".join([*lines, *(f"warning: {doubt}" for doubt in self.doubts)])

    @property
    def doubts(self) -> list[str]:
        """Why the result is probably wrong: poses that fit much worse than their σ."""
        factors = self.adjustment.sigma_factors
        worse = {name: factors[name] for name in PARTS if factors.get(name, 1) > WRONG_MISFIT}
        if not worse:
            return []
        excess = " and ".join(f"{name} {factor:.0f} times" for name, factor in worse.items())
        other_mounting = HAND_EYE[HAND_EYE.index(self.poses.type) - 1]
        return [
            f"{excess} worse than their σ: is the camera mounted as said ({self.poses.type}, not "
            f"{other_mounting}), do poses and photographs belong together, and are the units and "
            "the order of the rotations those of the robot?"
        ]


def hand_eye(
    input: Network | str | Path | Sequence[str | Path],
    poses: Any,
    *,
    board: Board | None = None,
    type: str = IN_HAND,
    sigma_position: float | None = None,
    sigma_angle: float | None = None,
    angle_unit: str | None = None,
    camera: Mapping[str, Any] | None = None,
    estimate_components: bool = True,
    **options: Any,
) -> HandEye:
    """Where a camera is on a robot, from a network or photographs, and the poses of the hand.

    **Arguments:**

    - `input`: a network, the path of one, or, with a `board`, photographs of it (files, patterns,
      folders), from which the camera is calibrated as well.
    - `poses`: a table of the columns of `robot_poses` (docs/project.md), or the path of its CSV;
      `image` names photographs.
    - `type`: "eye-in-hand", or "eye-to-hand" where the hand holds the object.
    - `sigma_position` (object unit), `sigma_angle`: the repeatability of the robot, for rows
      without their own; with `estimate_components` it is estimated from the residuals.
    - `angle_unit` of the poses and results: that of the network, "deg" of photographs.
    - `camera`: what is known of its mounting, as in the section `[hand_eye]`.
    - `options`: of `jaxbundle.adjust`; of photographs those of `jaxbundle.calibrate`.

    **Returns:** a `HandEye`; check `converged` first.

    **Raises:** `InputError`, also for motions that leave the mounting undetermined, with what is.
    """
    network = _network_of(input, board, angle_unit, options)
    table = read_csv(Path(poses)) if isinstance(poses, str | os.PathLike) else poses
    section: dict[str, Any] = {"type": type}
    options_of_section = {
        "sigma_position": sigma_position,
        "sigma_angle": sigma_angle,
        "camera": camera,
    }
    section |= {key: value for key, value in options_of_section.items() if value is not None}
    network = add_further(network, robot_poses=table, hand_eye=section)
    of_calibration = board is not None
    result = adjust(
        network, estimate_components=estimate_components, **({} if of_calibration else options)
    )
    return HandEye(result)


def _network_of(
    input: Network | str | Path | Sequence[str | Path],
    board: Board | None,
    angle_unit: str | None,
    options: Mapping[str, Any],
) -> Network:
    if board is not None:
        if isinstance(input, Network):
            raise InputError("board: is for photographs; a network has its points")
        names = [input] if isinstance(input, str | os.PathLike) else list(input)
        plain: dict[str, Any] = {"cross_validation": False, "correlated": False}
        calibration = calibrate(names, board, **(plain | dict(options)))
        network = readjustable_network(calibration.adjustment)
        return network.replace(angle_unit=angle_unit or "deg")
    if isinstance(input, str | os.PathLike):
        input = read_network(input)
    if not isinstance(input, Network):
        raise InputError(
            "input: several files are photographs of a board; expected its size as well (board=…)"
        )
    return input if angle_unit is None else input.replace(angle_unit=angle_unit)
