"""Variance components: test and estimation of the a priori precision of each group.

    σ̂²_g = (vᵀPv)_g / r_g,    r_g = Σ redundancy numbers of the group

(Förstner 1979). A value near 1 confirms the a priori σ of the group. Estimation repeats: scale
the σ of every group by σ̂_g, adjust again, until all components are 1. The product of these scales
is the *factor* of the group, applied to its given σ.
"""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from jaxbundle.leastsquares.problem import Problem, with_data
from jaxbundle.leastsquares.solution import Solution

# Largest number of estimations. Convergence is linear, and slow for groups of little redundancy,
# whose components are then of no use either: they are listed as unsettled.
ROUNDS = 20


# Residuals that are smaller, in σ, are rounding errors of the adjustment: the data are exact.
ROUNDING_SIGMA = 1e-9


class VarianceGroup(NamedTuple):
    """Observations whose σ are estimated together: sets, and which [rows, residuals] of each.

    `unit`: the factor from the unit of computation to that of the group, and `word` its name."""

    name: str
    parts: Sequence[tuple[str, Any]]
    unit: float = 1.0
    word: str = ""


@dataclasses.dataclass(frozen=True)
class Component:
    """A group of observations: number, redundancy, vᵀPv.

    `given`: the smallest and the largest given a priori σ (in the `unit` of the group; NaN
    if units differ). `factor`: applied to them before the adjustment, 1 unless
    components are estimated.
    """

    observations: int
    redundancy: float
    vtpv: float
    given: tuple[float, float]
    factor: float = 1.0
    unit: str = ""

    @property
    def ratio(self) -> float:
        """σ̂_g: estimated over used standard deviation; NaN with too little redundancy."""
        # Nothing but rounding: up to 1e-10 a redundancy number (`reliability.MIN_REDUNDANCY`), of
        # some ten thousand observations.
        if self.redundancy < 1e-6:
            return float("nan")
        return float(np.sqrt(self.vtpv / self.redundancy))

    @property
    def sigma(self) -> float:
        """Estimated over given standard deviation, `factor` × `ratio`."""
        return self.factor * self.ratio

    @property
    def estimated(self) -> tuple[float, float]:
        """The smallest and the largest estimated σ of the group."""
        smallest, largest = self.given
        return self.sigma * smallest, self.sigma * largest

    @property
    def usable(self) -> bool:
        """Whether the σ of the group can be estimated from its residuals."""
        # With a redundancy of 1 an estimated σ is right to 70 % (1/√(2r)), with less it says
        # nothing.
        return self.redundancy >= 1.0 and self.sigma > ROUNDING_SIGMA


def variance_components(
    solution: Solution, groups: Sequence[VarianceGroup], factors: Mapping[str, float]
) -> dict[str, Component]:
    """The components of groups of observations; `factors`: by group, the factor of σ that is
    applied already (1 if absent)."""
    problem, tested, components = solution.problem, solution.reliability, {}
    for group in groups:
        take = lambda by_set, group=group: np.concatenate(
            [np.zeros(0), *(np.asarray(by_set(o))[at].ravel() for o, at in group.parts)]
        )
        weight = take(problem.weights)
        weighted = weight[weight > 0]
        if weighted.size:
            # v·(P·v), of which the expectation is the redundancy number (with covariances too). P·v
            # is gain · standard (`Reliability`); standard is not yet divided by √r.
            v, r = take(tested.residual.get), take(tested.redundancy.get)
            square = v * take(tested.gain.get) * take(tested.standard.get)
            factor = factors.get(group.name, 1.0)
            unit = group.unit / factor
            components[group.name] = Component(
                weighted.size,
                float(r.sum()),
                float(square.sum()),
                (float(unit / weighted.max()), float(unit / weighted.min())),
                factor,
                group.word,
            )
    return components


class ComponentEstimate(NamedTuple):
    """Estimated variance components: the solution, the factors of σ by group, and the groups whose
    components have not converged."""

    solution: Solution
    factors: dict[str, float]
    unsettled: list[str]


def estimate(
    solution: Solution,
    groups: Sequence[VarianceGroup],
    again: Callable,
    smallest_change: float = 1e-3,
) -> ComponentEstimate:
    """Repeat Förstner's estimate until every component is 1.

    **Arguments:**

    - `again(problem, values)`: readjusts.
    - `smallest_change`: components closer to 1 are not estimated again: a thousandth of a σ that is
      known to a hundredth from 5000 observations.
    """
    factors: dict[str, float] = {}
    for round_number in range(ROUNDS + 1):
        components = variance_components(solution, groups, factors)
        usable = {name: c for name, c in components.items() if c.usable}
        factors = {name: c.factor for name, c in usable.items()} | factors
        unsettled = [name for name, c in usable.items() if abs(c.ratio - 1) >= smallest_change]
        if round_number == ROUNDS or not unsettled:
            return ComponentEstimate(solution, factors, unsettled)
        ratios = {name: c.ratio for name, c in usable.items()}
        # From the last values: weights change little from round to round.
        solution = again(rescale(solution.problem, groups, ratios), solution.values)
        factors |= {name: c.sigma for name, c in usable.items()}
    raise AssertionError("the last round returns")


def rescale(
    problem: Problem, groups: Sequence[VarianceGroup], factors: Mapping[str, float]
) -> Problem:
    """The problem with every group's σ multiplied by its factor."""
    weight = {o: np.array(w) for o, w in problem.data.weight.items()}
    for group in groups:
        for o, at in group.parts:
            weight[o][at] /= factors.get(group.name, 1.0)
    return with_data(problem, dataclasses.replace(problem.data, weight=weight))
