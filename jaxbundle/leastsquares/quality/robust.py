"""Robust estimation by iterative reweighting.

The length t of the residual vector of an observation, in units of its σ and of a robust scale s,
gives it the weight

    Huber    w = min(1, k/t)               k = 3           Huber (1964)
    Cauchy   w = 1/(1 + (t/k)²)            k = 2.5486      Holland and Welsch (1977)
    Tukey    w = (1 − (t/k)²)², t < k      k = 5.1230      Beaton and Tukey (1974)

and the problem is adjusted again with p = w/σ² until the weights converge (Krarup, Juhl and Kubik,
1980). The scale is a posteriori, so only the ratios of the given σ matter:

    s = median(t)/m·√(n/r),     m the median length of normal residuals,

a median absolute deviation (MAD), corrected for the redundancy r of n observations. A few blunders
do not change it; too small σ do.

With ψ(t) = w·t the efficiency for normal errors in the plane is E[ψ' + ψ/t]²/(2·E[ψ²]), t² ~ χ²₂
(Maronna, 1976): 0.95 for Cauchy's and Tukey's k. Huber's k leaves 99 of 100 good observations
unchanged, so that good data give the least-squares estimate. It has a unique solution and provides
start values and scale for the other two, which discard outliers.
"""

import dataclasses
import math

import numpy as np
from jaxtyping import Float

from jaxbundle.errors import InputError
from jaxbundle.leastsquares.indexing.rows import Values
from jaxbundle.leastsquares.problem import Problem, with_data
from jaxbundle.leastsquares.quality.distributions import chi2_quantile, critical_length
from jaxbundle.leastsquares.quality.snooping import Adjust, readjust
from jaxbundle.leastsquares.solution import Solution


def huber(t: Float[np.ndarray, " n"], k: float = 3.0) -> Float[np.ndarray, " n"]:
    """Weights of residual lengths t in units of their σ."""
    return np.minimum(1.0, k / np.maximum(t, k))


def cauchy(t: Float[np.ndarray, " n"], k: float = 2.5486) -> Float[np.ndarray, " n"]:
    """Weights of residual lengths t in units of their σ."""
    return 1 / (1 + (t / k) ** 2)


def tukey(t: Float[np.ndarray, " n"], k: float = 5.1230) -> Float[np.ndarray, " n"]:
    """Weights of residual lengths t in units of their σ."""
    return np.maximum(1 - np.minimum(t / k, 1.0) ** 2, 0.0) ** 2


@dataclasses.dataclass(frozen=True)
class ReweightingSettings:
    """The iteration of the weights.

    - `min_weight`: of an observation, so that the problem stays determined: σ a thousand times the
      given one, which moves no other unknown.
    - `converged_change`: weights with a smaller RMS change have converged: they then change no
      unknown by more than about that fraction of its σ.
    - `starting_change`: the same for Huber's weights that only start another estimator.
    - `max_rounds`: convergence is linear; data that need more have no clear majority.
    """

    min_weight: float = 1e-6
    converged_change: float = 1e-4
    starting_change: float = 1e-3
    max_rounds: int = 100


REWEIGHTING = ReweightingSettings()

_WEIGHT = {"huber": huber, "cauchy": cauchy, "tukey": tukey}


@dataclasses.dataclass(frozen=True)
class SuspectRow:
    """An observation whose residual exceeds the critical length: its set, row there, the length t
    of its residual in units of σ and scale, its weight factor."""

    set: str
    row: int
    test: float
    weight: float


@dataclasses.dataclass(frozen=True)
class Reweighted:
    """The solution with the last weights; by set their factors w; the scale a posteriori; whether
    the weights converged; `lengths` t in units of σ and scale."""

    solution: Solution
    weights: dict[str, Float[np.ndarray, " n"]]
    scale: float
    converged: bool
    lengths: dict[str, Float[np.ndarray, " n"]]

    def suspects(self, significance: float = 0.001) -> list[SuspectRow]:
        """Observations with residuals above the critical length, the worst first; `significance` is
        the probability of any in data without blunders."""
        problem = self.solution.problem
        residuals_each = {name: (problem.weights(name) > 0).sum(1) for name in self.lengths}
        observations = sum(int(np.count_nonzero(k)) for k in residuals_each.values())
        most = max((k.max(initial=0) for k in residuals_each.values()), default=0)
        critical = np.array(
            [np.inf, *(critical_length(significance, observations, k + 1) for k in range(most))]
        )
        suspects = [
            SuspectRow(name, row, float(t[row]), float(self.weights[name][row]))
            for name, t in self.lengths.items()
            for row in np.flatnonzero(t > critical[residuals_each[name]]).tolist()
        ]
        return sorted(suspects, key=lambda s: -s.test)


def residual_lengths(solution: Solution) -> dict[str, Float[np.ndarray, " n"]]:
    """|v/σ| of the observations that are removed or weighted as a whole, by set; not of those
    tested residual by residual, or never, like priors (`Kind.snooped`)."""
    return {
        o.name: np.sqrt((solution.residuals[o.name] ** 2).sum(1))
        for o in solution.problem.observations
        if o.kind.snooped == "whole"
    }


def robust_scale(problem: Problem, lengths: dict[str, Float[np.ndarray, " n"]]) -> float:
    """s of residual lengths |v/σ| of observations, by set; never 0."""
    normal = []  # |v/σ| by the median of the lengths of as many normal residuals
    for o, t in lengths.items():
        residuals_each = (problem.weights(o) > 0).sum(1)
        # Lengths of one, two or three residuals have different medians, √χ²₀.₅(k): divided by them
        # they are comparable.
        for k in np.unique(residuals_each[residuals_each > 0]).tolist():
            normal.append(t[residuals_each == k] / math.sqrt(chi2_quantile(0.5, k)))
    counts = problem.counts
    share = counts.redundancy / max(counts.redundancy + counts.unknowns - counts.datum, 1)
    # 1e-3: with a thousand unknowns for one redundant observation the scale is no estimate.
    scale = np.median(np.concatenate(normal)) / math.sqrt(max(share, 1e-3))
    return max(float(scale), np.finfo(float).tiny)


def reweight(
    problem: Problem,
    values: Values,
    adjust_from: Adjust,
    estimator: str,
    settings: ReweightingSettings = REWEIGHTING,
) -> Reweighted:
    """Adjust with the weights of an estimator until they converge.

    **Arguments:** `adjust_from(problem, start)`: the solution of a changed problem; `estimator`:
    one of `ESTIMATORS`.

    **Raises:** `InputError` if no observations are weighted as a whole.
    """
    if not any(x.kind.snooped == "whole" and x.number for x in problem.observations):
        raise InputError("robust estimation: no kind of observation is weighted as a whole")
    planned_weight, scale, converged = problem.data.weight, 1.0, False
    t = residual_lengths(Solution(problem, values))
    weighted, w = problem, {o: np.ones(len(x)) for o, x in t.items()}
    move = lambda problem, values, adjust_from: adjust_from(problem, values)
    # Redescending estimators (Cauchy, Tukey) have many solutions: from Huber's, which is unique,
    # and with its scale, they find the one of the majority.
    for name in dict.fromkeys(("huber", estimator)):
        small = settings.converged_change if name == estimator else settings.starting_change
        for _ in range(settings.max_rounds):
            scale = robust_scale(problem, t) if name == "huber" else scale
            previous = w
            min_weight = settings.min_weight
            w = {o: np.maximum(_WEIGHT[name](x / scale), min_weight) for o, x in t.items()}
            change = np.concatenate([w[o] - previous[o] for o in w])
            converged = bool(np.sqrt(np.mean(change**2)) < small)
            if converged:
                break
            # `weight` is 1/σ, or L⁻¹ [n, r, r]: both times √w of the observation.
            root = lambda o, p, w=w: np.sqrt(w[o]).reshape(-1, *(1,) * (np.ndim(p) - 1))
            weight = {
                o: np.asarray(p) * root(o, p) if o in w else p for o, p in planned_weight.items()
            }
            weighted = with_data(problem, dataclasses.replace(problem.data, weight=weight))
            # The first start values may be far from a solution.
            values = move(weighted, values, adjust_from).values
            move, t = readjust, residual_lengths(Solution(problem, values))
    # Single steps on the way; the last solution is iterated to the end.
    solution = adjust_from(weighted, values)
    return Reweighted(solution, w, scale, converged, {o: x / scale for o, x in t.items()})
