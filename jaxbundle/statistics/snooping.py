"""Data snooping: remove the worst observation, adjust again, until none is worse than the limit.

One at a time, because one blunder spoils the residuals of its neighbours (Baarda 1968). An image
point goes with both of its coordinates; a tie point that is left with one ray goes too. Removed
observations keep their rows with weight zero, so nothing is compiled again.
"""

import dataclasses
from collections.abc import Callable

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from jaxbundle.adjustment.problem import Problem, count_rows
from jaxbundle.network.arrays import Values
from jaxbundle.statistics.distributions import normal_quantile, tau_quantile
from jaxbundle.statistics.reliability import Reliability


@dataclasses.dataclass(frozen=True)
class Removed:
    """A removed observation: its kind, row in the arrays, a name for people, its test value."""

    kind: str
    row: int
    name: str
    test: float


def snoop(
    problem: Problem,
    values: Values,
    adjust_from: Callable[[Problem, Values], tuple[Values, Reliability, float]],
    *,
    test: str = "pope",
    significance: float = 0.001,
    limit: int | None = None,
    progress: Callable[[Removed], None] | None = None,
) -> tuple[Problem, Values, list[Removed]]:
    """Remove blunders one at a time.

    **Arguments:**

    - `adjust_from(problem, start)`: adjusted values, their reliability, σ̂0.
    - `test`: `"pope"` (σ a posteriori) or `"baarda"` (σ a priori).
    - `significance`: α of the single two-sided test; `limit`: at most so many removals.

    **Returns:** the problem without the removed observations, its solution, and what was removed
    in the order of removal.
    """
    if test not in ("pope", "baarda"):
        raise ValueError(f"test must be \"pope\" or \"baarda\", not {test!r}")
    removed: list[Removed] = []
    while True:
        values, found, sigma0 = adjust_from(problem, values)
        redundancy = problem.counts.redundancy
        if redundancy < 2 or (limit is not None and len(removed) >= limit):
            return problem, values, removed
        scale = sigma0 if test == "pope" else 1.0
        critical = (
            tau_quantile(1 - significance / 2, redundancy)
            if test == "pope"
            else normal_quantile(1 - significance / 2)
        )
        worst = _worst(problem, found, scale)
        if worst is None or worst.test < critical:
            return problem, values, removed
        removed.append(worst)
        if progress is not None:
            progress(worst)
        problem = without(problem, worst)


def _worst(problem: Problem, found: Reliability, scale: float) -> Removed | None:
    """The image point, control coordinate or distance with the largest test value."""
    image = np.abs(np.asarray(found.w.image)).max(1, initial=0.0, where=np.isfinite(found.w.image))
    control = np.abs(np.asarray(found.w.control))
    distance = np.abs(np.asarray(found.w.distance))
    candidates = []
    for kind, tests in (("image", image), ("control", control.ravel()), ("distance", distance)):
        tests = np.where(np.isfinite(tests), tests, -1.0)
        if tests.size and tests.max() > 0 and scale > 0:
            row = int(tests.argmax())
            candidates.append((float(tests[row]) / scale, kind, row))
    if not candidates:
        return None
    value, kind, row = max(candidates)
    return Removed(kind, row, _name(problem, kind, row), value)


def _name(problem: Problem, kind: str, row: int) -> str:
    s, network = problem.structure, problem.network
    if kind == "image":
        image, point = int(s.image[row]), int(s.point[row])
        return f"point {network.points.id[point]} in image {network.images.id[image]}"
    if kind == "control":
        point = int(s.control[row // 3])
        return f"{'XYZ'[row % 3]} of control point {network.points.id[point]}"
    a, b = (network.points.id[int(p)] for p in s.distance[row])
    return f"distance {a}–{b}"


def without(problem: Problem, removed: Removed) -> Problem:
    """The problem with one observation's weight set to zero, and a lone tie point set aside."""
    s, data = problem.structure, problem.data
    if removed.kind == "control":
        i, axis = divmod(removed.row, 3)
        weight = data.control_weight.at[i, axis].set(0.0)
        data = eqx.tree_at(lambda d: d.control_weight, data, weight)
    elif removed.kind == "distance":
        weight = data.distance_weight.at[removed.row].set(0.0)
        data = eqx.tree_at(lambda d: d.distance_weight, data, weight)
    else:
        weight = np.array(data.image_weight)
        weight[removed.row] = 0.0
        point = int(s.point[removed.row])
        rays = np.flatnonzero(np.asarray(s.point) == point)
        alone = (weight[rays] > 0).any(1).sum() < 2
        if alone and problem.network.points.role[point] == "tie" and point not in s.kept:
            weight[rays] = 0.0
            s = eqx.tree_at(
                lambda s: (s.point_free, s.eliminated, s.datum_weight),
                dataclasses.replace(s, all_free=False),
                (
                    s.point_free.at[point].set(0.0),
                    s.eliminated.at[point].set(0.0),
                    s.datum_weight.at[point].set(0.0),
                ),
            )
        data = eqx.tree_at(lambda d: d.image_weight, data, jnp.asarray(weight))
    return dataclasses.replace(
        problem, structure=s, data=data, counts=count_rows(s, data)
    )
