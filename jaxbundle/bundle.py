"""`adjust`: a network in, an `Adjustment` out; data snooping, elimination, variance components."""

import dataclasses
from collections.abc import Callable

import equinox as eqx
import jax
import numpy as np

from jaxbundle.adjustment.datum import move_to_datum
from jaxbundle.adjustment.problem import Problem, count_rows, make_problem, with_factor
from jaxbundle.adjustment.sharding import distribute, find_minimum_of_shards
from jaxbundle.adjustment.solve import converged, find_minimum, make_solver
from jaxbundle.adjustment.solver import SINGULAR, TERMINATIONS, Minimum
from jaxbundle.adjustment.unknowns import Name, undetermined
from jaxbundle.cameras import get_model
from jaxbundle.errors import NotSolvedError
from jaxbundle.network.arrays import Values
from jaxbundle.network.check import check_network
from jaxbundle.network.columns import some
from jaxbundle.network.padding import filled, pad_values, without_filling
from jaxbundle.network.sightings import split_check_points
from jaxbundle.network.tables import Network
from jaxbundle.result import Adjustment
from jaxbundle.statistics import (
    Component,
    Inspection,
    intersect_check_points,
    rescale,
    snoop,
    variance_components,
)

CORE_PARAMETERS = ("c", "x0", "y0", "fx", "fy", "cx", "cy", "f")
"""Interior parameters that are never eliminated for want of significance."""

RAYS_TO_SHARE = 10_000
"""Networks with so many rays are distributed over the devices, where there are several."""

RUNAWAY = 20.0
"""A principal distance that changed by more than this factor belongs to no camera."""

UNNAMED = ("a combination of unknowns that spreads over many of them",)
"""What is not determined, where none stands out."""

ROUNDS = 20
"""Variance components are estimated at most so many times."""


def adjust(
    network: Network,
    *,
    method: str = "levenberg-marquardt",
    reduction: str | None = None,
    max_iterations: int = 100,
    snooping: str | None = None,
    significance: float = 0.001,
    eliminate: bool = False,
    critical_t: float = 2.0,
    estimate_components: bool = False,
    progress: Callable | None = None,
) -> Adjustment:
    """Adjust a network by least squares, with self-calibration of whatever is free.

    **Arguments:**

    - `network`: see `jaxbundle.make_network`, `jaxbundle.read_network`, `jaxbundle.simulate`.
    - `method`: `"levenberg-marquardt"` or `"gauss-newton"`.
    - `reduction`: how the reduced system of images and cameras is solved: `"dense"`, `"banded"` or
      `"iterative"`; chosen by its size and fill if not given.
    - `snooping`: `"pope"` or `"baarda"`: remove blunders one at a time at the level
      `significance`.
    - `eliminate`: fix additional parameters with t < `critical_t` at 0, the least significant
      first, adjusting again each time.
    - `estimate_components`: scale the σ of each group of observations until its variance
      component is 1; `Adjustment.sigma_factors` says by how much.
    - `progress(step, cost, λ)`: called after every evaluation.

    **Returns:** an `Adjustment`; look at `converged` before anything else.

    **Raises:** `InputError` where the network cannot be adjusted as it stands; `NotSolvedError`
    where it, or what data snooping, elimination or variance components leave of it, determines no
    answer.
    """
    network = check_network(network)
    network, check_points, check_rays = split_check_points(network)
    problem = make_problem(network, reduction)
    network, used = problem.network, problem.structure.reduction
    options = {"method": method, "max_steps": max_iterations + 1, "progress": progress}
    minimum = _minimise(problem, problem.data.start, **options)
    problem = with_factor(problem)

    removed, eliminated, factors = [], [], {}
    if _solved(problem, minimum):
        again = lambda problem, values: _minimise(problem, values, **options)
        if snooping:
            problem, minimum, removed = _snooped(problem, minimum, again, snooping, significance)
        if estimate_components:
            problem, minimum, factors = _with_components(problem, minimum, again)
        if eliminate:
            problem, minimum, eliminated = _eliminated(problem, minimum, again, critical_t)

    inspection = _solved(problem, minimum)
    names = () if inspection else _names_of_defects(problem, minimum)
    if not inspection and converged(int(minimum.termination)):
        names = names or UNNAMED
    check = None
    if len(check_points):
        check = lambda result: intersect_check_points(
            result.inspection, result.values, check_points, check_rays, factors
        )
    return Adjustment(
        network, problem, minimum, removed=tuple(removed), eliminated=tuple(eliminated),
        undetermined=tuple(names), check=check, method=method, reduction=used,
        sigma_factors=factors, inspection=inspection,
    )  # fmt: skip


def _minimise(problem: Problem, start: Values, **options) -> Minimum:
    """Iterate from `start`; the datum and what is held stay those of the problem's own start."""
    solver, data = make_solver(problem, **options), problem.data
    if len(jax.devices()) > 1 and problem.structure.rays >= RAYS_TO_SHARE:
        minimum = find_minimum_of_shards(solver, distribute(problem), start)
        values = move_to_datum(problem.structure, minimum.values, data.start)
        return eqx.tree_at(lambda m: m.values, minimum, values)
    structure, data, sizes = filled(problem.structure, problem.data)
    solver = dataclasses.replace(solver, structure=structure)
    minimum = find_minimum(solver, data, pad_values(start, sizes))
    return eqx.tree_at(
        lambda m: m.values, minimum, without_filling(minimum.values, problem.data.start)
    )


def _solved(problem: Problem, minimum: Minimum) -> Inspection | None:
    """The solution, to be looked at: converged, no camera collapsed, all unknowns determined;
    else None."""
    if not bool(converged(int(minimum.termination))) or _collapsed(problem, minimum.values):
        return None
    inspection = Inspection(problem, minimum.values)
    return inspection if inspection.determined else None


def _collapsed(problem: Problem, values: Values) -> list[str]:
    """Principal distances that ran away from their start values by a factor of `RUNAWAY`.

    Where c and a scale of the image are free together, c = 0 makes all corrected residuals zero.
    """
    names = []
    now, before = np.asarray(values.camera), np.asarray(problem.data.start.camera)
    for c, camera in enumerate(problem.network.cameras):
        model = get_model(camera.model)
        for parameter in model.principal_distance:
            column = model.parameters.index(parameter)
            ratio = now[c, column] / before[c, column]
            if not 1 / RUNAWAY < float(ratio) < RUNAWAY:
                names.append(f"{parameter} of camera {camera.id} (it ran away from its start)")
    return names


def _names_of_defects(problem: Problem, minimum: Minimum) -> list[str]:
    values = minimum.values
    if bool(converged(int(minimum.termination))) and _collapsed(problem, values):
        return _collapsed(problem, values)
    if not all(np.isfinite(np.asarray(x)).all() for x in (values.camera, values.position)):
        values = problem.data.start
    return undetermined(problem, values, problem.data)


def _require_solved(problem: Problem, minimum: Minimum, when: str) -> None:
    """Refuse to go on from an adjustment repeated that was not solved."""
    if not _solved(problem, minimum):
        names = _names_of_defects(problem, minimum)
        reason = int(minimum.termination)
        why = TERMINATIONS[SINGULAR if bool(converged(reason)) else reason]
        if names:
            why = f"the network is no longer determined: {some(names, 8, str)}"
        raise NotSolvedError(f"not solved {when}: {why}", names)


def _snooped(problem, minimum, again, test, significance):
    last = {}

    def adjust_from(problem, values):
        result = again(problem, values)
        _require_solved(problem, result, "after data snooping")
        last["minimum"] = result
        found = Inspection(problem, result.values)
        sigma0 = float(np.sqrt(found.vtpv / max(problem.counts.redundancy, 1)))
        return result.values, found.reliability, sigma0

    problem, _, removed = snoop(
        problem, minimum.values, adjust_from, test=test, significance=significance
    )
    return problem, last["minimum"], removed


def _with_components(problem, minimum, again, tolerance: float = 1e-3):
    """Repeat Förstner's estimate until every component is 1 within `tolerance`.

    Also returned: by group, what its σ have been multiplied by.
    """
    factors: dict[str, float] = {}
    for done in range(ROUNDS + 1):
        found = Inspection(problem, minimum.values).reliability
        components = variance_components(problem, problem.data, found, factors)
        estimable = {name: c for name, c in components.items() if c.usable}
        factors = {name: c.factor for name, c in estimable.items()} | factors
        open_ones = [name for name, c in estimable.items() if abs(c.ratio - 1) >= tolerance]
        if done == ROUNDS or not open_ones:
            break
        ratios = {name: c.ratio for name, c in estimable.items()}
        data = rescale(problem.network.cameras, problem.structure, problem.data, ratios)
        problem = dataclasses.replace(problem, data=data)
        minimum = again(problem, minimum.values)
        _require_solved(problem, minimum, "with the estimated variance components")
        factors |= {name: c.sigma for name, c in estimable.items()}
    network = problem.network.warn(*_doubts(components, open_ones))
    return dataclasses.replace(problem, network=network), minimum, factors


def _doubts(components: dict[str, Component], open_ones: list[str]):
    """What is to be said of an estimate of variance components."""
    if open_ones:
        yield (
            f"the variance components did not settle in {ROUNDS} rounds ({', '.join(open_ones)}): "
            "their σ are not final"
        )
    for name, component in components.items():
        if not component.usable:
            why = "fit exactly" if component.redundancy >= 1 else "have too little redundancy"
            yield f"variance components: {name} {why}; their σ are left as they are"


def _eliminated(problem, minimum, again, critical_t):
    """Fix insignificant additional parameters at 0, the weakest first."""
    names = []
    while True:
        result = Adjustment(problem.network, problem, minimum)
        weak = [
            name for _, name in result.insignificant(critical_t)
            if name.parameter not in CORE_PARAMETERS
        ]  # fmt: skip
        if not weak:
            return problem, minimum, names
        names.append(weak[0])
        problem, values = _without_parameter(problem, minimum.values, weak[0])
        minimum = again(problem, values)
        _require_solved(problem, minimum, f"without {weak[0]}")


def _without_parameter(problem: Problem, values: Values, name: Name):
    s, data = problem.structure, problem.data
    c = [camera.id for camera in problem.network.cameras].index(name.id)
    model = get_model(problem.network.cameras[c].model)
    column = model.parameters.index(name.parameter)
    position = np.flatnonzero(
        (np.asarray(s.camera_columns)[c] == column) & (np.asarray(s.camera_free)[c] > 0)
    )[0]
    s = eqx.tree_at(
        lambda s: s.camera_free,
        dataclasses.replace(s, all_free=False),
        s.camera_free.at[c, position].set(0.0),
    )
    data = eqx.tree_at(
        lambda d: d.start.camera, data, data.start.camera.at[c, column].set(0.0)
    )
    row = np.flatnonzero(np.asarray(s.interior) == c)
    if len(row):
        weight = data.interior_weight.at[row[0], column].set(0.0)
        data = eqx.tree_at(lambda d: d.interior_weight, data, weight)
    values = eqx.tree_at(lambda v: v.camera, values, values.camera.at[c, column].set(0.0))
    counts = count_rows(s, data)
    return dataclasses.replace(problem, structure=s, data=data, counts=counts), values
