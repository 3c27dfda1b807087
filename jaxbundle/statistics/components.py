"""The groups of observations of a network whose σ are estimated together."""

import numpy as np

from jaxbundle.adjustment.problem import Problem
from jaxbundle.leastsquares.quality.components import VarianceGroup as Group
from jaxbundle.network.further import OF_ANGLES
from jaxbundle.network.units import ANGLE_UNITS


def groups(problem: Problem) -> list[Group]:
    """Image coordinates (by camera, if several have several images), control points by axis,
    priors, distances; further kinds by name."""
    network, layout, found = problem.network, problem.layout, []
    of = {
        f: [s.name for s in layout.sets if s.field == f]
        for f in ("image", "control", "exterior", "interior", "distance")
    }
    sets = [(s.name, s.cut(problem.camera)) for s in layout.sets if s.field == "image"]
    own = np.array_equal(network.images.camera, np.arange(len(network.cameras)))
    if len(network.cameras) == 1 or own:
        found.append(Group("image coordinates", [(o, np.s_[:]) for o, _ in sets]))
    else:
        found += [
            Group(
                f"image coordinates, camera {given.id}",
                [(o, np.flatnonzero(camera == c)) for o, camera in sets],
            )
            for c, given in enumerate(network.cameras)
        ]
    every = lambda field, *at: [(o, np.s_[:, *at] if at else np.s_[:]) for o in of[field]]
    for i, axis in enumerate("XYZ"):
        found.append(Group(f"control points in {axis}", every("control", i)))
    angle = 1 / ANGLE_UNITS[network.angle_unit]
    found += [
        Group("exterior orientation, position", every("exterior", np.s_[:3])),
        Group("exterior orientation, angles", every("exterior", np.s_[3:]), angle),
        Group("interior orientation", every("interior"), np.nan),
        Group("distances", every("distance")),
    ]
    further: dict[str, list] = {}
    for given in map(problem.system.observations_of, layout.others):
        further.setdefault(given.kind.name, []).append((given.name, np.s_[:]))
    unit = lambda name: angle if name in OF_ANGLES else 1.0
    return found + [Group(name, parts, unit(name)) for name, parts in further.items()]
