"""Observed parameters of cameras, and ratios of two of them: table `camera_parameters`.

A row: `camera`, `parameter` (or `fy/fx`, the ratio of two), `value`, `sigma`. Unlike `sigma` of a
camera, which observes the start value, a row has a value of its own: a focal length from the file
of a photograph stays the observation when the adjustment starts elsewhere.
"""

import dataclasses
from collections.abc import Mapping
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from jaxbundle.cameras import get_model
from jaxbundle.errors import InputError
from jaxbundle.leastsquares.declarations import Kind
from jaxbundle.leastsquares.spaces import Change
from jaxbundle.network.camera_tables import camera_tables
from jaxbundle.network.columns import Columns, did_you_mean
from jaxbundle.network.kinds.base import Contribution, ObservationTable, positive_sigma
from jaxbundle.network.tables import Network
from jaxbundle.types import Scalar

RATIO = "/"


@dataclasses.dataclass(frozen=True)
class ObservedParameter:
    """A parameter, or its ratio to another one, minus the observed value; columns in the table of
    the camera."""

    column: int
    divisor: int | None = None

    def __call__(self, camera: Change, observed: Scalar) -> Scalar:
        value = camera[self.column]
        return (value if self.divisor is None else value / camera[self.divisor]) - observed


@dataclasses.dataclass(frozen=True, kw_only=True)
class CameraParameters(ObservationTable):
    """Observed values of camera parameters, or of their ratios, and their σ, in the units of the
    camera models."""

    camera: tuple[str, ...]
    parameter: tuple[str, ...]
    value: Float[np.ndarray, " n"]
    sigma: Float[np.ndarray, " n"]

    TABLE = "camera_parameters"

    @classmethod
    def from_columns(
        cls, table: Columns, settings: Mapping[str, Any], radians: float
    ) -> "CameraParameters":
        table.check_names(("camera", "parameter", "value", "sigma"))
        return cls(
            camera=table.ids("camera"),
            parameter=table.ids("parameter"),
            value=table.numbers("value", required=True),
            sigma=positive_sigma(table, "sigma"),
            source=table.source,
        )

    def columns(self, radians: float) -> dict:
        return {
            "camera": self.camera,
            "parameter": self.parameter,
            "value": self.value,
            "sigma": self.sigma,
        }

    def __len__(self) -> int:
        return len(self.camera)

    def _included_rows(self, network: Network) -> Bool[np.ndarray, " n"]:
        known_ids = {camera.id for camera in network.cameras}
        return np.array([id in known_ids for id in self.camera], bool)

    def check(self, network: Network) -> None:
        cameras = {camera.id: camera for camera in network.cameras}
        for row, (id, parameter) in enumerate(zip(self.camera, self.parameter)):
            if id not in cameras:
                raise InputError(
                    f"{self.source(row)}: camera {id!r} is unknown{did_you_mean(id, cameras)}"
                )
            camera = cameras[id]
            known_parameters, names = get_model(camera.model).parameters, parameter.split(RATIO)
            if len(names) > 2:
                raise InputError(
                    f"{self.source(row)}: expected a parameter or a ratio of two, "
                    f"such as fy/fx, got {parameter!r}"
                )
            for name in names:
                if name not in known_parameters:
                    raise InputError(
                        f"{self.source(row)}: camera {id!r} has no {name!r}"
                        f"{did_you_mean(name, known_parameters)}"
                    )
            groups = {name: group for group in camera.tie for name in group}
            # A ratio of two tied parameters is a constant, and a held parameter no unknown.
            is_constant = len(names) == 2 and groups.get(names[0], {*names}) == groups.get(names[1])
            if is_constant or not {*camera.free} & {m for n in names for m in groups.get(n, (n,))}:
                raise InputError(
                    f"{self.source(row)}: {parameter} of camera {id!r} cannot change: expected "
                    f"{' or '.join(names)} to be free" + (" and not tied" if is_constant else "")
                )

    def declare(self, network: Network, origin: Float[np.ndarray, "3"]) -> Contribution:
        index = {camera.id: c for c, camera in enumerate(network.cameras)}
        place = {
            int(c): (table, k)
            for table in camera_tables(network.cameras)
            for k, c in enumerate(table.cameras)
        }
        sets: dict[tuple, list[int]] = {}
        for row, (id, parameter) in enumerate(zip(self.camera, self.parameter)):
            table, _ = place[index[id]]
            columns = map(table.parameters.index, parameter.split(RATIO))
            residual = ObservedParameter(*columns)
            sets.setdefault((table.name, parameter, residual), []).append(row)
        kind = lambda table, parameter, residual: Kind(
            "camera parameters", residual, (table,), (parameter,), snooped="", invariant=True
        )
        return Contribution(
            (),
            tuple(
                kind(*key)(
                    (np.array([place[index[self.camera[row]]][1] for row in rows]),),
                    self.value[rows],
                    sigma=self.sigma[rows],
                )
                for key, rows in sets.items()
            ),
        )
