"""The groups of observations of a network whose σ are estimated together."""

from typing import Any

import numpy as np

from jaxbundle.adjustment.problem import NetworkProblem
from jaxbundle.cameras import get_model
from jaxbundle.leastsquares.quality.variance_components import VarianceGroup as Group
from jaxbundle.network.units import unit_words


def groups(problem: NetworkProblem) -> list[Group]:
    """Image coordinates (by camera, if several have several images), control points by axis,
    priors, distances; further kinds by name."""
    network = problem.network
    words = unit_words(network)
    length, angle, image = (words[kind] for kind in ("length", "angle", "image"))
    # A camera for each image has too few observations for a component of its own: one for all.
    one_image_each = np.array_equal(network.images.camera, np.arange(len(network.cameras)))
    if len(network.cameras) == 1 or one_image_each:
        parts = [(name, np.s_[:]) for name in problem.image_rows]
        variance_groups = [Group("image coordinates", parts, *image)]
    else:
        variance_groups = [
            Group(
                f"image coordinates, camera {camera.id}",
                [
                    (name, np.flatnonzero(problem.camera[rows] == c))
                    for name, rows in problem.image_rows.items()
                ],
                1.0,
                get_model(camera.model).unit,
            )
            for c, camera in enumerate(network.cameras)
        ]
    declared_sets = [o.name for o in problem.observations]
    interior = [table.interior_set for table in problem.cameras]

    def whole_sets(*names: str, columns: Any = None) -> list[tuple[str, Any]]:
        place = np.s_[:] if columns is None else np.s_[:, columns]
        return [(name, place) for name in names if name in declared_sets]

    # Heights of control are often of another precision than its position.
    for i, axis in enumerate("XYZ"):
        variance_groups.append(
            Group(f"control points in {axis}", whole_sets("control", columns=i), *length)
        )
    variance_groups += [
        Group("exterior orientation, position", whole_sets("exterior", columns=np.s_[:3]), *length),
        Group("exterior orientation, angles", whole_sets("exterior", columns=np.s_[3:]), *angle),
        Group("interior orientation", whole_sets(*interior), np.nan),
        Group("distances", whole_sets("distance"), *length),
    ]
    # Of kinds with several units the factor has none.
    kinds: dict[str, tuple[list, tuple[float, str]]] = {}
    for name in problem.further_sets:
        kind = problem.observations_of(name).kind
        units = kind.units if isinstance(kind.units, str) else "several"
        parts, _ = kinds.setdefault(kind.name, ([], words.get(units, (np.nan, ""))))
        parts.append((name, np.s_[:]))
    return variance_groups + [Group(name, parts, *unit) for name, (parts, unit) in kinds.items()]
