"""Iterate to a minimum and check whether it is a solution."""

import dataclasses
from collections.abc import Iterator, Mapping

import numpy as np

from jaxbundle.adjustment.problem import NetworkProblem
from jaxbundle.adjustment.quality.inspection import Inspection
from jaxbundle.adjustment.quality.weakness import Weakness, weakness_of_unsolved
from jaxbundle.cameras import get_model
from jaxbundle.errors import NotSolvedError
from jaxbundle.leastsquares.indexing.rows import Values
from jaxbundle.leastsquares.iterations.solver import Minimum
from jaxbundle.leastsquares.iterations.stopping import LIMIT, SINGULAR, TERMINATIONS, converged
from jaxbundle.leastsquares.quality.nondifferentiable import without_derivatives
from jaxbundle.leastsquares.quality.null_space import (
    undetermined_eliminated_unknowns,
    undetermined_unknowns,
)
from jaxbundle.network.columns import list_some
from jaxbundle.network.tables import Camera

# Reduced systems with more unknowns are not searched for null vectors: the time of a dense
# eigendecomposition grows with the cube of their number, and would soon be minutes.
MAX_FOR_EIGENVECTORS = 3000
# A principal distance that changed by more than this factor is implausible. Half and double
# make no difference: a start value is seldom wrong by more than two, and a collapsing c passes
# every factor.
LARGEST_FACTOR = 20.0


def inspect_solution(problem: NetworkProblem, minimum: Minimum[Values]) -> Inspection | None:
    """The solution if it converged, no camera collapsed and all unknowns are determined; else
    None."""
    if not bool(converged(int(minimum.termination))) or _find_collapsed(problem, minimum.values):
        return None
    inspection = Inspection(problem, minimum.values)
    return inspection if inspection.determined else None


def names_of_defects(problem: NetworkProblem, minimum: Minimum[Values]) -> list[str]:
    """The undetermined unknowns where the iterations ended; for a large network, where eigenvectors
    take too long, the weak ones if it is singular."""
    values = minimum.values
    if bool(converged(int(minimum.termination))) and (fallen := _find_collapsed(problem, values)):
        return fallen
    last_values = _last_values(problem, minimum)
    if problem.plan.reduction == "dense" and problem.reduced_size <= MAX_FOR_EIGENVECTORS:
        return undetermined_unknowns(problem, last_values)
    rows = undetermined_eliminated_unknowns(problem, last_values)
    if rows:
        return rows
    singular = bool(converged(int(minimum.termination))) or int(minimum.termination) == SINGULAR
    return list(weakness_without_solution(problem, minimum).unknowns) if singular else []


def name_inseparable(
    problem: NetworkProblem, minimum: Minimum[Values], inseparable: float = 1e-7
) -> str:
    """Why the iterations may have reached their limit: unknowns that the observations hardly
    separate, in words; empty if there are none, or in a large network.

    `inseparable`: eigenvalues of the reduced normal matrix, scaled by the diagonal before the
    elimination (`quality.null_space`), below this: along such a vector one σ of
    a single unknown becomes 1/√1e-7 = 3000, so that hardly an observation changes and the
    iterations take long."""
    if int(minimum.termination) != LIMIT or problem.plan.reduction != "dense":
        return ""
    if problem.reduced_size > MAX_FOR_EIGENVECTORS:
        return ""
    names = undetermined_unknowns(problem, _last_values(problem, minimum), inseparable)
    # Where a camera parameter is open, so are the orientations that follow it: it is the cause.
    names = [name for name in names if " of camera " in name] or names
    if not names:
        return ""
    return (
        f"hardly separated where the iterations ended: {list_some(names, 8, str)}; hold some of "
        "them, give them a prior σ, or raise the limit of iterations"
    )


def name_undefined(problem: NetworkProblem, minimum: Minimum[Values]) -> str:
    """The distances and observations of further kinds that have no derivatives where the iterations
    ended, in words; empty if there are none. (Image points have none where a camera model has no
    image: of that other causes are named.)"""
    sets = ("distance", *problem.further_sets)
    names = list(without_derivatives(problem, _last_values(problem, minimum), sets))
    if not names:
        return ""
    return (
        f"no derivative (as at a distance of 0, or an angle of 180°): {list_some(names, 5, str)}; "
        "give their points start values that are not in one place or on one line, or remove them"
    )


def weakness_without_solution(problem: NetworkProblem, minimum: Minimum[Values]) -> Weakness:
    """The poorly determined unknowns where the iterations ended."""
    return weakness_of_unsolved(problem, _last_values(problem, minimum))


def _last_values(problem: NetworkProblem, minimum: Minimum[Values]) -> Values:
    """The values at the end of the iterations, or the start values if those are not finite."""
    return minimum.values if are_finite(problem, minimum.values) else problem.data.start


def are_finite(problem: NetworkProblem, values: Values) -> bool:
    """Whether all projection centres and camera parameters are finite."""
    rows = (values["image"].position, *(values[table.name] for table in problem.cameras))
    return all(np.isfinite(np.asarray(x)).all() for x in rows)


def require_solved(problem: NetworkProblem, minimum: Minimum[Values], when: str) -> Inspection:
    """The solution of a repeated adjustment; refused if it was not solved.

    **Raises:** `NotSolvedError`."""
    inspection = inspect_solution(problem, minimum)
    if not inspection:
        names = names_of_defects(problem, minimum)
        reason = int(minimum.termination)
        # Converged, but no solution: some unknowns are undetermined there.
        why = TERMINATIONS[SINGULAR if bool(converged(reason)) else reason]
        if names:
            why = f"the network is no longer determined: {list_some(names, 8, str)}"
        raise NotSolvedError(f"not solved {when}: {why}", names)
    return inspection


def _find_collapsed(problem: NetworkProblem, values: Values) -> list[str]:
    """Principal distances that diverged from their start values by a factor of `LARGEST_FACTOR`.

    If c and a scale of the corrected image are both free, the image shrinks to a point at c = 0,
    with residuals of zero.
    """
    return [
        f"{parameter} of camera {camera.id} (it diverged from its start value)"
        for camera, parameter, ratio in _principal_distances(problem, values)
        if not 1 / LARGEST_FACTOR < ratio < LARGEST_FACTOR
    ]


def is_misjudged(problem: NetworkProblem, minimum: Minimum[Values], ratio: float = 1.03) -> bool:
    """Whether an adjusted principal distance differs from the given one by more than the factor
    `ratio`, but plausibly: start values are then computed again. `orient` asks for a principal
    distance that is right to a few percent; within that nothing is excluded because of it."""
    changes = [change for *_, change in _principal_distances(problem, minimum.values)]
    sane = all(1 / LARGEST_FACTOR < change < LARGEST_FACTOR for change in changes)
    return sane and any(not 1 / ratio < change < ratio for change in changes)


def adjusted_cameras(problem: NetworkProblem, values: Values) -> dict[str, Camera]:
    """The cameras of the network by id, with the parameters of a solution."""
    return {
        camera.id: dataclasses.replace(
            camera, parameters=dict(zip(get_model(camera.model).parameters, row))
        )
        for camera, row in zip(
            problem.network.cameras, np.asarray(problem.interior_orientation(values)).tolist()
        )
    }


def start_with(problem: NetworkProblem, cameras: Mapping[str, Camera]) -> Values:
    """The start values of a problem with the parameters of these cameras."""
    start = problem.data.start
    rows = np.array(problem.interior_orientation(start))
    for row, camera in zip(rows, problem.network.cameras):
        parameters_of = cameras.get(camera.id, camera).parameters
        for column, name in enumerate(get_model(camera.model).parameters):
            row[column] = parameters_of.get(name, row[column])
    return problem.with_interior_orientation(start, rows)


def _principal_distances(
    problem: NetworkProblem, values: Values
) -> Iterator[tuple[Camera, str, float]]:
    """Camera, name and change factor of all principal distances."""
    interior = lambda values: np.asarray(problem.interior_orientation(values))
    adjusted, start = interior(values), interior(problem.data.start)
    for c, camera in enumerate(problem.network.cameras):
        model = get_model(camera.model)
        for parameter in model.principal_distance:
            column = model.parameters.index(parameter)
            yield camera, parameter, float(adjusted[c, column] / start[c, column])
