"""The cameras of a network as tables of unknowns: those of one model share one."""

import dataclasses
from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Float, Int

from jaxbundle.cameras import CameraModel, default_parameters, get_model, key_of
from jaxbundle.leastsquares import declarations as ls
from jaxbundle.leastsquares.spaces import Vector
from jaxbundle.network.tables import Camera


@dataclasses.dataclass(frozen=True)
class CameraTable:
    """The cameras of one model with the same ties: the name of their table, the model, its
    parameters, and the indices of the cameras."""

    name: str
    model: str | CameraModel
    parameters: tuple[str, ...]
    cameras: Int[np.ndarray, " rows"]
    tie: tuple[tuple[str, ...], ...] = ()

    @property
    def image_set(self) -> str:
        """The name of the set of image points of these cameras."""
        return self.name.replace("camera", "image", 1)

    @property
    def interior_set(self) -> str:
        """The name of the set of priors of these cameras."""
        return self.name.replace("camera", "interior", 1)

    def start(self, cameras: Sequence[Camera]) -> Float[np.ndarray, "rows parameters"]:
        """The start values of their parameters."""
        return np.array([start_of(cameras[c]) for c in self.cameras])

    def unknowns(self, cameras: Sequence[Camera]) -> ls.Table:
        """The table; only parameters that are free in some camera are unknowns."""
        table_cameras = [cameras[c] for c in self.cameras]
        unknowns = [camera.unknowns for camera in table_cameras]
        free = np.array([[name in names for name in self.parameters] for names in unknowns])
        # Columns that are free in no camera are constants of the formula, not unknowns held at 0:
        # the reduced matrix is smaller.
        moving = tuple(np.flatnonzero(free.any(0)).tolist())
        column_of = self.parameters.index
        tied_columns = tuple(
            (column_of(name), moving.index(column_of(group[0])))
            for group in self.tie
            if column_of(group[0]) in moving
            for name in group[1:]
        )
        return ls.Table(
            self.name,
            self.start(cameras),
            Vector(len(self.parameters), moving, tied_columns),
            free[:, moving],
            [camera.id for camera in table_cameras],
            tuple(self.parameters[j] for j in moving),
            "camera",
        )


def camera_tables(cameras: Sequence[Camera]) -> tuple[CameraTable, ...]:
    """Groups of cameras that share a table: those of one model with the same ties."""
    # One table a model, since its rows have the same columns and one compiled formula; ties are
    # part of the space of a table, so cameras with other ties have their own.
    keys = [(get_model(c.model), c.tie) for c in cameras]
    distinct_keys = tuple(dict.fromkeys(keys))
    name_of = lambda model, tie: ", ".join(["camera", model.name, *(" = ".join(g) for g in tie)])
    return tuple(
        CameraTable(
            "camera" if len(distinct_keys) == 1 else name_of(model, tie),
            key_of(model),
            model.parameters,
            np.array([c for c, s in enumerate(keys) if s == (model, tie)]),
            tie,
        )
        for model, tie in distinct_keys
    )


def with_start(camera: Camera, parameters: Mapping[str, float]) -> Camera:
    """The camera with other start values; its priors observe what they did."""
    start = dict(zip(get_model(camera.model).parameters, start_of(camera)))
    observed = {name: camera.observed.get(name, start[name]) for name in camera.sigma}
    return dataclasses.replace(camera, parameters=parameters, observed=observed)


def start_of(camera: Camera) -> list[float]:
    """The start values of all parameters of a camera."""
    model = get_model(camera.model)
    values = {**default_parameters(model), **camera.parameters}
    return [values[name] for name in model.parameters]
