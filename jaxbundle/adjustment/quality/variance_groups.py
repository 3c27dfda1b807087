"""The groups of observations of a network whose σ are estimated together."""

from typing import Any

import numpy as np

from jaxbundle.adjustment.problem import NetworkProblem
from jaxbundle.leastsquares.quality.variance_components import VarianceGroup as Group
from jaxbundle.network.units import unit_words


def groups(problem: NetworkProblem) -> list[Group]:
    """Image coordinates (by camera, if several have several images), control points by axis,
    priors, distances; further kinds by name."""
    network = problem.network
    words = unit_words(network)
    length, angle, image = (words[kind] for kind in ("length", "angle", "image"))
    # A camera for each image has too few observations for a component of its own: one for all.
    own = np.array_equal(network.images.camera, np.arange(len(network.cameras)))
    if len(network.cameras) == 1 or own:
        parts = [(name, np.s_[:]) for name in problem.image_rows]
        found = [Group("image coordinates", parts, *image)]
    else:
        found = [
            Group(
                f"image coordinates, camera {given.id}",
                [
                    (name, np.flatnonzero(problem.camera[rows] == c))
                    for name, rows in problem.image_rows.items()
                ],
                *image,
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
        found.append(Group(f"control points in {axis}", every("control", columns=i), *length))
    found += [
        Group("exterior orientation, position", every("exterior", columns=np.s_[:3]), *length),
        Group("exterior orientation, angles", every("exterior", columns=np.s_[3:]), *angle),
        Group("interior orientation", every(*interior), np.nan),
        Group("distances", every("distance"), *length),
    ]
    # Of kinds with several units the factor has none.
    further: dict[str, tuple[list, tuple[float, str]]] = {}
    for name in problem.further_sets:
        kind = problem.observations_of(name).kind
        units = kind.units if isinstance(kind.units, str) else "several"
        parts, _ = further.setdefault(kind.name, ([], words.get(units, (np.nan, ""))))
        parts.append((name, np.s_[:]))
    return found + [Group(name, parts, *unit) for name, (parts, unit) in further.items()]
