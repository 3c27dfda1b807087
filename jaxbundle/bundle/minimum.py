"""Iterate to a minimum and check whether it is a solution."""

import dataclasses
from collections.abc import Mapping

import equinox as eqx
import jax
import numpy as np

from jaxbundle.adjustment.problem import Problem
from jaxbundle.cameras import get_model
from jaxbundle.errors import NotSolvedError
from jaxbundle.leastsquares.iterations.solver import Minimum
from jaxbundle.leastsquares.iterations.stopping import LIMIT, SINGULAR, TERMINATIONS, converged
from jaxbundle.leastsquares.quality.names import undetermined, undetermined_rows
from jaxbundle.leastsquares.solution import find_minimum
from jaxbundle.network.arrays import Values
from jaxbundle.network.columns import list_some
from jaxbundle.network.tables import Camera
from jaxbundle.statistics.inspection import Inspection
from jaxbundle.statistics.weakness import Weakness, weakness_of_unsolved

MISJUDGED_RATIO = 1.03
"""If a principal distance changed by more than this factor, start values are computed again."""

INSEPARABLE = 1e-7
"""Scaled eigenvalues of the normal matrix below this: a change of the unknowns by many σ hardly
changes an observation, and the iterations take long."""
EIGENVECTORS = 3000
"""Reduced systems with more unknowns are not searched for null vectors, which would take
minutes."""

LARGEST_FACTOR = 20.0
"""A principal distance that changed by more than this factor is implausible."""


def minimise(problem: Problem, start: Values, **options) -> Minimum[Values]:
    """Iterate from `start`; the datum and held values remain those of the problem's start."""
    found = find_minimum(problem.system, problem.layout.tables(start), **options)
    values = problem.layout.values(found.values)
    return Minimum(values, found.termination, found.iterations, found.history)


def inspect_solution(problem: Problem, minimum: Minimum[Values]) -> Inspection | None:
    """The solution if it converged, no camera collapsed and all unknowns are determined; else
    None."""
    if not bool(converged(int(minimum.termination))) or _find_collapsed(problem, minimum.values):
        return None
    inspection = Inspection(problem, minimum.values)
    return inspection if inspection.determined else None


def names_of_defects(problem: Problem, minimum: Minimum[Values]) -> list[str]:
    """The undetermined unknowns where the iterations ended; for a large network, where eigenvectors
    take too long, the weak ones if it is singular."""
    values = minimum.values
    if bool(converged(int(minimum.termination))) and _find_collapsed(problem, values):
        return _find_collapsed(problem, values)
    system = problem.system
    if system.plan.reduction == "dense" and system.reduced_size <= EIGENVECTORS:
        return undetermined(system, problem.layout.tables(_last(problem, minimum)))
    rows = undetermined_rows(system, problem.layout.tables(_last(problem, minimum)))
    if rows:
        return rows
    singular = bool(converged(int(minimum.termination))) or int(minimum.termination) == SINGULAR
    return list(weakness_without_solution(problem, minimum).unknowns) if singular else []


def name_inseparable(problem: Problem, minimum: Minimum[Values]) -> str:
    """Why the iterations may have reached their limit: unknowns that the observations hardly
    separate, in words; empty if there are none, or in a large network."""
    system = problem.system
    if int(minimum.termination) != LIMIT or system.plan.reduction != "dense":
        return ""
    if system.reduced_size > EIGENVECTORS:
        return ""
    tables = problem.layout.tables(_last(problem, minimum))
    names = undetermined(system, tables, INSEPARABLE)
    # Orientations follow the cameras.
    names = [name for name in names if " of camera " in name] or names
    if not names:
        return ""
    return (
        f"hardly separated where the iterations ended: {list_some(names, 8, str)}; hold some of "
        "them, give them a prior σ, or raise the limit of iterations"
    )


def weakness_without_solution(problem: Problem, minimum: Minimum[Values]) -> Weakness:
    """The poorly determined unknowns where the iterations ended."""
    return weakness_of_unsolved(problem, _last(problem, minimum))


def _last(problem: Problem, minimum: Minimum[Values]) -> Values:
    """The values at the end of the iterations, or the start values if those are not finite."""
    values = minimum.values
    finite = all(np.isfinite(np.asarray(x)).all() for x in (values.camera, values.position))
    return values if finite else problem.data.start


def require_solved(problem: Problem, minimum: Minimum[Values], when: str) -> Inspection:
    """The solution of a repeated adjustment; refused if it was not solved.

    **Raises:** `NotSolvedError`."""
    found = inspect_solution(problem, minimum)
    if not found:
        names = names_of_defects(problem, minimum)
        reason = int(minimum.termination)
        why = TERMINATIONS[SINGULAR if bool(converged(reason)) else reason]
        if names:
            why = f"the network is no longer determined: {list_some(names, 8, str)}"
        raise NotSolvedError(f"not solved {when}: {why}", names)
    return found


def _find_collapsed(problem: Problem, values: Values) -> list[str]:
    """Principal distances that diverged from their start values by a factor of `LARGEST_FACTOR`.

    If c and an image scale are both free, c = 0 makes all corrected residuals zero.
    """
    return [
        f"{parameter} of camera {camera.id} (it diverged from its start value)"
        for camera, parameter, ratio in _principal_distances(problem, values)
        if not 1 / LARGEST_FACTOR < ratio < LARGEST_FACTOR
    ]


def is_misjudged(problem: Problem, minimum: Minimum[Values]) -> bool:
    """Whether an adjusted principal distance differs from the given one, but plausibly."""
    ratios = [ratio for *_, ratio in _principal_distances(problem, minimum.values)]
    sane = all(1 / LARGEST_FACTOR < ratio < LARGEST_FACTOR for ratio in ratios)
    return sane and any(not 1 / MISJUDGED_RATIO < ratio < MISJUDGED_RATIO for ratio in ratios)


def adjusted_cameras(problem: Problem, values: Values) -> dict[str, Camera]:
    """The cameras of the network by id, with the parameters of a solution."""
    return {
        camera.id: dataclasses.replace(
            camera, parameters=dict(zip(get_model(camera.model).parameters, row))
        )
        for camera, row in zip(problem.network.cameras, np.asarray(values.camera).tolist())
    }


def start_with(problem: Problem, cameras: Mapping[str, Camera]) -> Values:
    """The start values of a problem with the parameters of these cameras."""
    start = problem.data.start
    rows = np.array(start.camera)
    for row, camera in zip(rows, problem.network.cameras):
        given = cameras.get(camera.id, camera).parameters
        for column, name in enumerate(get_model(camera.model).parameters):
            row[column] = given.get(name, row[column])
    return eqx.tree_at(lambda v: v.camera, start, jax.device_put(rows))


def _principal_distances(problem: Problem, values: Values):
    """Camera, name and change factor of all principal distances."""
    now, before = np.asarray(values.camera), np.asarray(problem.data.start.camera)
    for c, camera in enumerate(problem.network.cameras):
        model = get_model(camera.model)
        for parameter in model.principal_distance:
            column = model.parameters.index(parameter)
            yield camera, parameter, float(now[c, column] / before[c, column])
