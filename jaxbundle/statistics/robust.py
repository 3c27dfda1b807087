"""Robust estimation: image points that fit badly count less, by repeated weighting.

The length t of the residual vector of an image point, in units of its σ and of a robust scale s,
gives it the weight

    Huber    w = min(1, k/t)               k = 3           Huber (1964)
    Cauchy   w = 1/(1 + (t/k)²)            k = 2.5486      Holland and Welsch (1977)
    Tukey    w = (1 − (t/k)²)², t < k      k = 5.1230      Beaton and Tukey (1974)

and the network is adjusted again with p = w/σ² until the weights rest (Krarup, Juhl and Kubik,
1980). The scale s is a posteriori, from the median of the residuals (`misfit.py`), so the σ given
matter only in proportion to each other.

With ψ(t) = w·t the efficiency for normal errors in the plane is E[ψ' + ψ/t]²/(2·E[ψ²]), t² ~ χ²₂
(Maronna, 1976): 0.95 for Cauchy's and Tukey's k. Huber's k leaves 99 of 100 good points alone, so
that the estimate of good data stays that of least squares. It has one solution, and is the start of
the other two, which discard what is far off; they keep its scale.
"""

import dataclasses

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxbundle.adjustment.problem import Problem
from jaxbundle.network.arrays import Values
from jaxbundle.statistics.distributions import critical_length
from jaxbundle.statistics.inspection import Inspection
from jaxbundle.statistics.misfit import robust_scale
from jaxbundle.statistics.readjusting import Adjust, readjust
from jaxbundle.statistics.snooping import name_of

ESTIMATORS = ("huber", "cauchy", "tukey")
LEAST_WEIGHT = 1e-6
"""Weights of image points do not fall lower, so that the network stays determined."""
RESTING, NEARLY_RESTING = 1e-4, 1e-3
"""Weights whose changes have a smaller root mean square are at rest; those that only give the
start of another estimator need not be so near."""
ROUNDS = 100


def huber(t: Float[np.ndarray, " n"], k: float = 3.0) -> Float[np.ndarray, " n"]:
    """Weights of residual lengths t in units of their σ."""
    return np.minimum(1.0, k / np.maximum(t, k))


def cauchy(t: Float[np.ndarray, " n"], k: float = 2.5486) -> Float[np.ndarray, " n"]:
    """Weights of residual lengths t in units of their σ."""
    return 1 / (1 + (t / k) ** 2)


def tukey(t: Float[np.ndarray, " n"], k: float = 5.1230) -> Float[np.ndarray, " n"]:
    """Weights of residual lengths t in units of their σ."""
    return np.maximum(1 - np.minimum(t / k, 1.0) ** 2, 0.0) ** 2


_WEIGHT = {"huber": huber, "cauchy": cauchy, "tukey": tukey}


@dataclasses.dataclass(frozen=True)
class Suspect:
    """An observation whose residual is too long for a good one: its kind, row in the arrays, a name
    for people, the length of its residual t in units of σ and scale, the factor of its weight."""

    kind: str
    row: int
    name: str
    test: float
    weight: float


@dataclasses.dataclass(frozen=True)
class Reweighted:
    """The solution with the last weights; their factors w in the order of the arrays; the scale a
    posteriori; whether the weights came to rest; `lengths` t in units of σ and scale."""

    found: Inspection
    weights: Float[np.ndarray, " rays"]
    scale: float
    rests: bool
    lengths: Float[np.ndarray, " rays"]

    def suspects(self, significance: float = 0.001) -> list[Suspect]:
        """Image points with longer residuals than the longest of good ones, the worst first; with
        the probability `significance` there is any in a network without blunders."""
        problem = self.found.problem
        used = (np.asarray(problem.data.image_weight) > 0).any(1)
        critical = critical_length(significance, int(used.sum()))
        rows = np.flatnonzero(used & (self.lengths > critical))
        rows = rows[np.argsort(-self.lengths[rows], kind="stable")]
        return [
            Suspect("image", row, name_of(problem, "image", row), float(self.lengths[row]),
                    float(self.weights[row]))
            for row in rows.tolist()
        ]  # fmt: skip


def reweight(
    problem: Problem,
    values: Values,
    adjust_from: Adjust,
    estimator: str,
) -> Reweighted:
    """Adjust with weights of an estimator until they rest.

    **Arguments:** `adjust_from(problem, start)`: the solution of a changed problem; `estimator`:
    one of `ESTIMATORS`.
    """
    given, scale, rests = np.asarray(problem.data.image_weight), 1.0, False
    weighted, w, t = problem, np.ones(len(given)), Inspection(problem, values).lengths
    move = lambda problem, values, adjust_from: adjust_from(problem, values)
    for name in dict.fromkeys(("huber", estimator)):
        resting = RESTING if name == estimator else NEARLY_RESTING
        for _ in range(ROUNDS):
            scale = robust_scale(problem, t) if name == "huber" else scale
            before, w = w, np.maximum(_WEIGHT[name](t / scale), LEAST_WEIGHT)
            rests = bool(np.sqrt(np.mean((w - before) ** 2)) < resting)
            if rests:
                break
            weight = jnp.asarray(given * np.sqrt(w)[:, None])
            data = eqx.tree_at(lambda d: d.image_weight, problem.data, weight)
            weighted = dataclasses.replace(problem, data=data)
            # The first start values may be far from a solution.
            values = move(weighted, values, adjust_from).adjusted
            move, t = readjust, Inspection(problem, values).lengths
    found = adjust_from(weighted, values)
    return Reweighted(found, w, scale, rests, t / scale)

