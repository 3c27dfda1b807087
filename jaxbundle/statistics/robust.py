"""Robust estimation: image points that fit badly count less, by repeated weighting.

The length t of the residual vector of an image point, in units of its σ and of a robust scale s,
gives it the weight

    Huber    w = min(1, k/t)               k = 3           Huber (1964)
    Cauchy   w = 1/(1 + (t/k)²)            k = 2.5486      Holland and Welsch (1977)
    Tukey    w = (1 − (t/k)²)², t < k      k = 5.1230      Beaton and Tukey (1974)

and the network is adjusted again with p = w/σ² until the weights rest (Krarup, Juhl and Kubik,
1980). s = median(t)/√(2·ln 2)·√(n/r): the median length of normal residuals is 1.1774 σ, smaller
by the redundancy r of n coordinates.

With ψ(t) = w·t the efficiency for normal errors in the plane is E[ψ' + ψ/t]²/(2·E[ψ²]), t² ~ χ²₂
(Maronna, 1976): 0.95 for Cauchy's and Tukey's k. Huber's k leaves 99 of 100 good points alone, so
that the estimate of good data stays that of least squares. It has one solution, and is the start of
the other two, which discard what is far off; they keep its scale.
"""

import dataclasses
import math
from collections.abc import Callable

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxbundle.adjustment.problem import Problem
from jaxbundle.network.arrays import Values
from jaxbundle.statistics.inspection import Inspection

ESTIMATORS = ("huber", "cauchy", "tukey")
LEAST_WEIGHT = 1e-6
"""Weights of image points do not fall lower, so that the network stays determined."""
RESTING = 1e-4
"""Weights whose changes have a smaller root mean square are at rest."""
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


def reweight(
    problem: Problem,
    values: Values,
    adjust_from: Callable[[Problem, Values], Values],
    estimator: str,
) -> tuple[Problem, Values, Float[np.ndarray, " rays"], bool]:
    """Adjust with weights of an estimator until they rest.

    **Arguments:** `adjust_from(problem, start)`: adjusted values; `estimator`: one of `ESTIMATORS`.

    **Returns:** the problem with the last weights, its solution, the factor w of every image point,
    and whether the weights came to rest.
    """
    given = np.asarray(problem.data.image_weight)
    weighted, w, scale = problem, np.ones(len(given)), None
    for name in dict.fromkeys(("huber", estimator)):
        for _ in range(ROUNDS):
            t = _lengths(problem, values)
            fixed = scale if name != "huber" else _scale(problem, weighted, t)
            now = np.maximum(_WEIGHT[name](t / fixed), LEAST_WEIGHT)
            rests = np.sqrt(np.mean((now - w) ** 2)) < RESTING
            w, scale = now, fixed
            if rests:
                break
            weight = jnp.asarray(given * np.sqrt(w)[:, None])
            data = eqx.tree_at(lambda d: d.image_weight, problem.data, weight)
            weighted = dataclasses.replace(problem, data=data)
            values = adjust_from(weighted, values)
    return weighted, values, w, bool(rests)


def _lengths(problem: Problem, values: Values) -> Float[np.ndarray, " rays"]:
    """|v/σ| of every image point with its given σ."""
    return np.hypot(*np.asarray(Inspection(problem, values).residuals.image).T)


def _scale(problem: Problem, weighted: Problem, t: Float[np.ndarray, " rays"]) -> float:
    used = (np.asarray(problem.data.image_weight) > 0).any(1)
    counts = weighted.counts
    share = counts.redundancy / max(counts.redundancy + counts.unknowns - counts.datum, 1)
    scale = np.median(t[used]) / math.sqrt(2 * math.log(2)) / math.sqrt(max(share, 1e-3))
    return max(float(scale), np.finfo(float).tiny)
