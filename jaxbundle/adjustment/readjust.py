"""Repeated adjustments: robust estimation, data snooping, variance components, and without camera
parameters that are not significant."""

import dataclasses
from collections.abc import Callable, Iterable, Iterator
from typing import cast

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from jaxbundle.adjustment.minimum import inspect_solution, require_solved
from jaxbundle.adjustment.problem import NetworkProblem
from jaxbundle.adjustment.quality.blunder_names import (
    chosen_points_removed,
    image_points_removed,
    name_removed,
)
from jaxbundle.adjustment.quality.inspection import Inspection
from jaxbundle.adjustment.quality.misfit import contradicts, doubt_of_baarda
from jaxbundle.adjustment.quality.variance_groups import groups
from jaxbundle.adjustment.result import Adjustment
from jaxbundle.cameras import default_parameters, get_model
from jaxbundle.errors import NotSolvedError
from jaxbundle.leastsquares.indexing.rows import Values
from jaxbundle.leastsquares.iterations.solver import Minimum
from jaxbundle.leastsquares.problem import Problem, hold, with_data
from jaxbundle.leastsquares.quality.names import Name
from jaxbundle.leastsquares.quality.robust import (
    Reweighted,
    residual_lengths,
    reweight,
    robust_scale,
)
from jaxbundle.leastsquares.quality.snooping import (
    RemovedRow,
    readjust,
    snoop,
    solve_without,
    without,
)
from jaxbundle.leastsquares.quality.variance_components import (
    ROUNDS,
    Component,
    estimate,
    variance_components,
)
from jaxbundle.leastsquares.solution import Solution
from jaxbundle.network.blunders import Removed, removed_rays

# Iterates a changed problem from given values to its minimum; returns the problem as it ended.
Minimise = Callable[[Problem, Values], tuple[NetworkProblem, Minimum]]


def snoop_network(
    inspection: Inspection,
    minimum: Minimum,
    minimise_again: Minimise,
    test: str,
    significance: float,
    doubtful: Iterable[tuple[str, str]] = (),
) -> tuple[NetworkProblem, Minimum, list[Removed], str | None]:
    """The problem and its minimum without blunders, the removed observations, and a warning about a
    priori σ that the test relies on although the data contradict them (None without).

    `doubtful`: image and point, by id, of initially removed image points."""
    # The engine removes and restores in its own terms (sets and rows); names are given at the end.
    problem, solution_with_all, doubt = inspection.problem, inspection.solution, None
    repeat = _Repeat(minimise_again, "after data snooping", minimum)
    solution, removed = snoop(
        solution_with_all,
        repeat,
        test=test,
        significance=significance,
        doubtful=image_points_removed(problem, doubtful),
    )
    removed = [name_removed(problem, r) for r in removed]
    counts = problem.counts
    if test == "baarda" and counts.redundancy > 0:
        # Its own adjustments, whose minima are not that of the result (`repeat`).
        scale = _scale_of_good(
            solution_with_all, _Repeat(minimise_again, "after data snooping", minimum)
        )
        rays = len(removed_rays(removed))
        doubt = doubt_of_baarda(
            scale,
            rays,
            problem.rows_and_unknowns.observations // 2,
            counts.redundancy,
            significance,
        )
    return cast(NetworkProblem, solution.problem), repeat.minimum, removed, doubt


def values_without(
    result: Adjustment,
    values: Values,
    sigma_factor: Float[np.ndarray, " rays"],
    is_left_out: Bool[np.ndarray, " rays"],
    minimise_again: Minimise,
) -> Values:
    """Where the adjustment of a result ends, from values near to it, without some image points and
    with the σ of the others times a factor; in a large network after a single step.

    **Raises:** `NotSolvedError`."""
    problem = result.problem
    weight = problem.image_weights / sigma_factor[:, None]
    reweighted = with_data(problem, problem.with_image_weights(problem.data, weight))
    left_out = chosen_points_removed(problem, is_left_out)
    repeat = _Repeat(minimise_again, "without gross errors", result.minimum)
    step = lambda problem, values: readjust(problem, values, repeat)
    return solve_without(reweighted, left_out, set(), values, step).values


def _scale_of_good(solution: Solution, repeat: "_Repeat") -> float:
    """The robust scale of the image points, whatever the a priori σ.

    The observations left by Baarda's test fit too well, because they were selected for it; and
    blunders spread over the residuals of good points. So if the scale of all points is large, the
    scale of those that Tukey's estimator (with a posteriori scale) does not suspect is used.
    """
    problem = solution.problem
    scale = robust_scale(problem, residual_lengths(solution))
    if scale < 1 or not contradicts(scale, problem.counts.redundancy):
        return scale
    try:
        tukey = reweight(problem, solution.values, repeat, "tukey")
    except NotSolvedError:
        return scale
    # Suspects are only left out of the median: the adjustment keeps the observations it has.
    suspects = [RemovedRow(s.set, s.row, None, s.test) for s in tukey.suspects()]
    if not suspects:
        return scale
    lengths = {o: t * tukey.scale for o, t in tukey.lengths.items()}
    return robust_scale(without(problem, suspects), lengths)


def adjust_robustly(
    problem: NetworkProblem, minimum: Minimum, minimise_again: Minimise, estimator: str
) -> tuple[Reweighted, Minimum]:
    """The solution with the weights of a robust estimator, and its minimum. The first weights come
    from the minimum, or from the start values without a solution."""
    repeat = _Repeat(minimise_again, "by robust estimation", minimum)
    # Weights of start values are poor, but where blunders prevent a solution there are no others.
    start = minimum.values if inspect_solution(problem, minimum) else problem.data.start
    reweighted = reweight(problem, start, repeat, estimator)
    if not reweighted.converged:
        raise NotSolvedError(
            f"not solved by robust estimation: the weights of {estimator} do not converge; use "
            f"{'' if estimator == 'huber' else 'huber, or '}data snooping"
        )
    return reweighted, repeat.minimum


class _Repeat:
    """Adjusts a changed problem of the network and keeps the minimum."""

    def __init__(self, minimise_again: Minimise, when: str, minimum: Minimum):
        self.again, self.when, self.minimum = minimise_again, when, minimum

    def __call__(self, problem: Problem, values: Values) -> Solution:
        of_network, self.minimum = self.again(problem, values)
        return require_solved(of_network, self.minimum, self.when).solution


def with_components(
    problem: NetworkProblem, minimum: Minimum, minimise_again: Minimise
) -> tuple[NetworkProblem, Minimum, dict[str, float]]:
    """The problem with estimated σ of every group, its minimum, and the factors of σ by group."""
    repeat = _Repeat(minimise_again, "with the estimated variance components", minimum)
    # σ̂² of a group is vᵀPv/r of the group (Förstner 1979): iterated, since both depend on all σ.
    # Groups with too little redundancy keep their σ, which is reported in a note.
    solution, variance_groups = Inspection(problem, minimum.values).solution, groups(problem)
    estimated, factors, unsettled = estimate(solution, variance_groups, repeat)
    components = variance_components(estimated, variance_groups, factors)
    network = problem.network.note(*_unchanged(components))
    if unsettled:
        network = network.warn(
            f"the variance components did not converge in {ROUNDS} rounds "
            f"({', '.join(unsettled)}): their σ are not final"
        )
    problem = dataclasses.replace(cast(NetworkProblem, estimated.problem), network=network)
    return problem, repeat.minimum, factors


def _unchanged(components: dict[str, Component]) -> Iterator[str]:
    """Notes on groups whose variance component cannot be estimated."""
    for name, component in components.items():
        if not component.usable:
            why = "fit exactly" if component.redundancy >= 1 else "have too little redundancy"
            yield f"variance components: {name} {why}; their σ are unchanged"


def eliminate_parameters(
    problem: NetworkProblem, minimum: Minimum, minimise_again: Minimise, critical_t: float
) -> tuple[NetworkProblem, Minimum, list[Name]]:
    """Hold insignificant additional parameters at their default (mostly 0), the weakest first."""
    names = []
    models = {camera.id: get_model(camera.model) for camera in problem.network.cameras}
    while True:
        # One parameter a round: eliminating one changes the t of all that are correlated with it.
        result = Adjustment(problem.network, problem, minimum)
        weak = [
            name
            for _, name in result.insignificant(critical_t)
            if name.parameter not in models[name.id].core
        ]
        if not weak:
            return problem, minimum, names
        names.append(weak[0])
        problem, values = _without_parameter(problem, minimum.values, weak[0])
        problem, minimum = minimise_again(problem, values)
        require_solved(problem, minimum, f"without {weak[0]}")


def _without_parameter(
    problem: NetworkProblem, values: Values, name: Name
) -> tuple[NetworkProblem, Values]:
    """The problem with a parameter held at its default, and all parameters tied to it; priors of
    these have no weight any more, or they would count as observations of a constant."""
    c = [camera.id for camera in problem.network.cameras].index(name.id)
    model = get_model(problem.network.cameras[c].model)
    column = model.parameters.index(name.parameter)
    equal_parameters = next((g for g in problem.network.cameras[c].tie if name.parameter in g), ())
    columns = np.array([model.parameters.index(n) for n in equal_parameters or (name.parameter,)])
    value = default_parameters(model)[name.parameter]
    table, row = problem.table_of_camera(c)
    rows_with_value = lambda rows: jnp.asarray(rows).at[row, columns].set(value)
    reset = lambda values: values | {table.name: rows_with_value(values[table.name])}
    weight = dict(problem.data.weight)
    if table.interior_set in weight:
        (prior,) = np.nonzero(problem.observations_of(table.interior_set).rows[0] == row)
        weights = jnp.asarray(weight[table.interior_set])
        weight[table.interior_set] = weights.at[np.ix_(prior, columns)].set(0.0)
    data = dataclasses.replace(problem.data, start=reset(problem.data.start), weight=weight)
    moving = problem.table(table.name).vector.moving.index(column)
    return hold(with_data(problem, data), table.name, row, [moving]), reset(values)
