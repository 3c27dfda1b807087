"""Priors of interior orientation: camera parameters with σ, observed at their start values or at
other ones (`Camera.observed`)."""

import dataclasses
from typing import TYPE_CHECKING

import numpy as np

from jaxbundle.leastsquares.declarations import Kind, ObservationSet
from jaxbundle.network.kinds.base import computed_minus_given

if TYPE_CHECKING:
    from jaxbundle.network.camera_tables import CameraTable
    from jaxbundle.network.tables import Network


def interior_orientation(camera: str, parameters: tuple[str, ...]) -> Kind:
    """Priors of the parameters of the cameras of a table."""
    return Kind(
        "interior orientation",
        computed_minus_given,
        (camera,),
        parameters,
        snooped="",
        invariant=True,
    )


def declare_interior_orientation(
    network: "Network", tables: "tuple[CameraTable, ...]"
) -> list[ObservationSet]:
    """A set for every table of cameras of which one has a σ, one row a camera that has."""
    sets = []
    observed = [
        dataclasses.replace(camera, parameters={**camera.parameters, **camera.observed})
        for camera in network.cameras
    ]
    for table in tables:
        table_cameras = [network.cameras[c] for c in table.cameras]
        sigma = np.array(
            [
                [
                    camera.sigma.get(p, np.inf) if p in camera.free else np.inf
                    for p in table.parameters
                ]
                for camera in table_cameras
            ]
        )
        rows = np.flatnonzero(np.isfinite(sigma).any(1))
        if len(rows):
            kind = interior_orientation(table.name, table.parameters)
            value = table.start(observed)[rows]
            sets.append(kind((rows,), value, sigma=sigma[rows], name=table.interior_set))
    return sets
