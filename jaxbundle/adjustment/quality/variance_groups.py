"""The groups of observations of a network whose σ are estimated together."""

from typing import Any

import numpy as np

from jaxbundle.adjustment.problem import NetworkProblem
from jaxbundle.leastsquares.quality.variance_components import VarianceGroup as Group
from jaxbundle.network.units import ANGLE_UNITS


def groups(problem: NetworkProblem) -> list[Group]:
    """Image coordinates (by camera, if several have several images), control points by axis,
    priors, distances; further kinds by name."""
    network = problem.network
    # A camera for each image has too few observations for a component of its own: one for all.
    own = np.array_equal(network.images.camera, np.arange(len(network.cameras)))
    if len(network.cameras) == 1 or own:
        found = [Group("image coordinates", [(name, np.s_[:]) for name in problem.image_rows])]
    else:
        found = [
            Group(
                f"image coordinates, camera {given.id}",
                [
                    (name, np.flatnonzero(problem.camera[rows] == c))
                    for name, rows in problem.image_rows.items()
                ],
            )
            for c, given in enumerate(network.cameras)
        ]
    given = [o.name for o in problem.observations]
    interior = [table.interior_set for table in problem.cameras]

    def every(*names: str, columns: Any = None) -> list[tuple[str, Any]]:
        place = np.s_[:] if columns is None else np.s_[:, columns]
        return [(name, place) for name in names if name in given]

    # Heights of control are often of another precision than its position.
    for i, axis in enumerate("XYZ"):
        found.append(Group(f"control points in {axis}", every("control", columns=i)))
    angle = 1 / ANGLE_UNITS[network.angle_unit]
    found += [
        Group("exterior orientation, position", every("exterior", columns=np.s_[:3])),
        Group("exterior orientation, angles", every("exterior", columns=np.s_[3:]), angle),
        Group("interior orientation", every(*interior), np.nan),
        Group("distances", every("distance")),
    ]
    # Of kinds with several units the factor has none.
    scale, further = {"length": 1.0, "image": 1.0, "angle": angle}, {}
    for name in problem.further_sets:
        kind = problem.observations_of(name).kind
        units = kind.units if isinstance(kind.units, str) else "several"
        _, parts = further.setdefault(kind.name, (scale.get(units, np.nan), []))
        parts.append((name, np.s_[:]))
    return found + [Group(name, parts, unit) for name, (unit, parts) in further.items()]
