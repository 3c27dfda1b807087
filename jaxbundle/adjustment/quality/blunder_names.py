"""Names in network terms of the blunders and suspects that the engine found."""

import math
from collections.abc import Iterable, Sequence

import numpy as np
from jaxtyping import Bool

from jaxbundle.adjustment.problem import NetworkProblem
from jaxbundle.leastsquares.quality import robust, snooping
from jaxbundle.network.blunders import Removed, Suspect, either_of
from jaxbundle.types import not_none


def name_removed(problem: NetworkProblem, removed_row: snooping.RemovedRow) -> Removed:
    """Observations removed by data snooping, with names."""
    kind, rows = _place(problem, removed_row.set, removed_row.rows)
    names = [_name(problem, removed_row.set, row, removed_row.residual) for row in removed_row.rows]
    # Control points lose single axes: their rows count axes, three a point.
    if kind == "control":
        rows = tuple(3 * row + not_none(removed_row.residual) for row in rows)
    return Removed(kind, rows[0], either_of(names), removed_row.test, rows[1:])


def image_points_removed(
    problem: NetworkProblem, pairs_of_ids: Iterable[tuple[str, str]]
) -> list[snooping.RemovedRow]:
    """Image points, by image and point id, as removals for data snooping."""
    pairs_of_ids = set(pairs_of_ids)
    if not pairs_of_ids:
        return []
    images, points = problem.network.images.id, problem.network.points.id
    places = zip(problem.image.tolist(), problem.point.tolist())
    is_removed = np.array([(images[i], points[p]) in pairs_of_ids for i, p in places], bool)
    return chosen_points_removed(problem, is_removed)


def chosen_points_removed(
    problem: NetworkProblem, is_removed: Bool[np.ndarray, " rays"]
) -> list[snooping.RemovedRow]:
    """Chosen image points as removals for data snooping."""
    return [
        snooping.RemovedRow(name, row, None, math.inf)
        for name, places in problem.image_rows.items()
        for row in np.flatnonzero(is_removed[places]).tolist()
    ]


def name_suspect(problem: NetworkProblem, suspect_row: robust.SuspectRow) -> Suspect:
    """Suspects of the robust estimation, with names."""
    kind, rows = _place(problem, suspect_row.set, (suspect_row.row,))
    name = _name(problem, suspect_row.set, suspect_row.row, None)
    return Suspect(kind, rows[0], name, suspect_row.test, suspect_row.weight)


def _place(problem: NetworkProblem, name: str, rows: Sequence[int]) -> tuple[str, tuple[int, ...]]:
    """Kind and rows: of image points those of the network, of others those of their set."""
    if name in problem.image_rows:
        return "image", tuple(int(problem.image_rows[name][row]) for row in rows)
    if name in problem.further_sets:
        return problem.observations_of(name).kind.name, tuple(rows)
    return name.partition(",")[0], tuple(rows)


def _name(problem: NetworkProblem, name: str, row: int, residual: int | None) -> str:
    kind, (place,) = _place(problem, name, (row,))
    network, observation_set = problem.network, problem.observations_of(name)
    points = network.points.id
    if kind == "image":
        image = network.images.id[problem.image[place]]
        return f"point {points[problem.point[place]]} in image {image}"
    if kind == "control":
        return (
            f"{'XYZ'[not_none(residual)]} of control point {points[observation_set.rows[0][row]]}"
        )
    if kind == "distance":
        a, b = (points[int(p)] for p in network.distances.points[place])
        return f"distance {a}–{b}"
    return observation_set.label(problem.tables, row)
