"""Adjustments repeated: robust estimation, data snooping, variance components, elimination."""

import dataclasses

import equinox as eqx
import numpy as np

from jaxbundle.adjustment.problem import Problem, count_rows
from jaxbundle.adjustment.unknowns import Name
from jaxbundle.cameras import default_parameters, get_model
from jaxbundle.errors import NotSolvedError
from jaxbundle.network.arrays import Values
from jaxbundle.result import Adjustment
from jaxbundle.solution import require_solved, solved
from jaxbundle.statistics import (
    Component,
    Inspection,
    contradicts,
    doubt_of_baarda,
    rescale,
    reweight,
    robust_scale,
    snoop,
    variance_components,
)
from jaxbundle.statistics.snooping import Removed, without

ROUNDS = 20
"""Variance components are estimated at most so many times."""


def snooped(found: Inspection, minimum, again, test: str, significance: float):
    """The problem and its minimum without blunders, what was removed, and what is to be said of σ
    that the test trusts though the data contradict them."""
    whole, doubt = found, None
    repeat = _Repeat(again, "after data snooping", minimum)
    found, removed = snoop(found, repeat, test=test, significance=significance)
    counts = whole.problem.counts
    if test == "baarda" and counts.redundancy > 0:
        scale = _scale_of_good(whole, _Repeat(again, "after data snooping", minimum))
        rays = sum(len(r.rows) for r in removed if r.kind == "image")
        doubt = doubt_of_baarda(
            scale, rays, counts.observations // 2, counts.redundancy, significance
        )
    return found.problem, repeat.minimum, removed, doubt


def _scale_of_good(found: Inspection, repeat: "_Repeat") -> float:
    """The robust scale of the image points, whatever the a priori σ.

    What Baarda's test leaves fits too well, for it is what fitted; and blunders spread over the
    residuals of good points. So where the scale of all points is large, it is that of those which
    Tukey's estimator does not suspect, whose own scale is a posteriori.
    """
    problem = found.problem
    scale = robust_scale(problem, found.lengths)
    if scale < 1 or not contradicts(scale, problem.counts.redundancy):
        return scale
    try:
        tukey = reweight(problem, found.adjusted, repeat, "tukey")
    except NotSolvedError:
        return scale
    suspects = [Removed("image", s.row, s.name, s.test) for s in tukey.suspects()]
    if not suspects:
        return scale
    return robust_scale(without(problem, *suspects), tukey.lengths * tukey.scale)


def robustly(problem: Problem, minimum, again, estimator: str):
    """The solution with the weights of a robust estimator, and its minimum. The first weights come
    from the minimum, or from the start values if it is no solution."""
    repeat = _Repeat(again, "by robust estimation", minimum)
    first = minimum.values if solved(problem, minimum) else problem.data.start
    reweighted = reweight(problem, first, repeat, estimator)
    if not reweighted.rests:
        raise NotSolvedError(
            f"not solved by robust estimation: the weights of {estimator} do not come to rest; use "
            f"{'' if estimator == 'huber' else 'huber, or '}data snooping"
        )
    return reweighted, repeat.minimum


class _Repeat:
    """Adjusts a changed problem, and keeps the minimum."""

    def __init__(self, again, when: str, minimum):
        self.again, self.when, self.minimum = again, when, minimum

    def __call__(self, problem: Problem, values: Values) -> Inspection:
        self.minimum = self.again(problem, values)
        return require_solved(problem, self.minimum, self.when)


def with_components(problem, minimum, again, tolerance: float = 1e-3):
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
        require_solved(problem, minimum, "with the estimated variance components")
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


def eliminated_parameters(problem, minimum, again, critical_t):
    """Fix insignificant additional parameters at 0, or their default, the weakest first."""
    names = []
    models = {camera.id: get_model(camera.model) for camera in problem.network.cameras}
    while True:
        result = Adjustment(problem.network, problem, minimum)
        weak = [
            name for _, name in result.insignificant(critical_t)
            if name.parameter not in models[name.id].core
        ]  # fmt: skip
        if not weak:
            return problem, minimum, names
        names.append(weak[0])
        problem, values = _without_parameter(problem, minimum.values, weak[0])
        minimum = again(problem, values)
        require_solved(problem, minimum, f"without {weak[0]}")


def _without_parameter(problem: Problem, values: Values, name: Name):
    s, data = problem.structure, problem.data
    c = [camera.id for camera in problem.network.cameras].index(name.id)
    model = get_model(problem.network.cameras[c].model)
    column = model.parameters.index(name.parameter)
    value = default_parameters(model)[name.parameter]
    position = np.flatnonzero(
        (np.asarray(s.camera_columns)[c] == column) & (np.asarray(s.camera_free)[c] > 0)
    )[0]
    s = eqx.tree_at(
        lambda s: s.camera_free,
        dataclasses.replace(s, all_free=False),
        s.camera_free.at[c, position].set(0.0),
    )
    data = eqx.tree_at(
        lambda d: d.start.camera, data, data.start.camera.at[c, column].set(value)
    )
    row = np.flatnonzero(np.asarray(s.interior) == c)
    if len(row):
        weight = data.interior_weight.at[row[0], column].set(0.0)
        data = eqx.tree_at(lambda d: d.interior_weight, data, weight)
    values = eqx.tree_at(lambda v: v.camera, values, values.camera.at[c, column].set(value))
    counts = count_rows(s, data)
    return dataclasses.replace(problem, structure=s, data=data, counts=counts), values
