"""Data snooping: remove what the test calls a blunder, adjust again, until nothing is worse.

    |w|  > z(1 − α/2)                        Baarda (1968): each observation by itself
    |τ|  > τ(1 − α'/2, redundancy)           Pope (1976): the largest of n, α' = 1 − (1 − α)^(1/n)

One blunder spoils the residuals of its neighbours. So of every image and of every point only the
worst ray goes at a time, and only rays at least half as bad as the worst of all; a control
coordinate or a distance goes alone. An image point goes with both of its coordinates; a tie point
that is left with one ray goes too. In the end whatever was removed is held against the adjustment
it took no part in, by its predicted residual v and the variance σ²·(1 + h) of that: what passes
comes back. Removed observations keep their rows with weight zero, so nothing is compiled again.
"""

import dataclasses
from collections.abc import Callable, Sequence

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from jaxbundle.adjustment.problem import Problem, count_rows
from jaxbundle.arguments import number
from jaxbundle.errors import InputError
from jaxbundle.network.arrays import Values
from jaxbundle.statistics.distributions import critical_w
from jaxbundle.statistics.inspection import Inspection

TOGETHER = 0.5
"""Rays are removed together with the worst one if their test is at least this part of its."""


@dataclasses.dataclass(frozen=True)
class Removed:
    """A removed observation: its kind, row in the arrays, a name for people, its test value."""

    kind: str
    row: int
    name: str
    test: float


TESTS = ("pope", "baarda")


def check_test(test: str | None, significance: float, option: str = "") -> None:
    """Refuse a test that is none, and a level that is no probability; `option` stands before the
    names in the message.

    **Raises:** `InputError`.
    """
    if test is not None and (not isinstance(test, str) or test not in TESTS):
        raise InputError(f"{option}snooping {test!r}: {' or '.join(TESTS)}")
    number(f"{option}significance", significance, "a number between 0 and 1", lambda a: 0 < a < 1)


def snoop(
    problem: Problem,
    values: Values,
    adjust_from: Callable[[Problem, Values], Values],
    *,
    test: str = "pope",
    significance: float = 0.001,
    limit: int | None = None,
) -> tuple[Problem, Values, list[Removed]]:
    """Remove blunders, the worst first.

    **Arguments:**

    - `adjust_from(problem, start)`: adjusted values.
    - `test`: `"pope"` (σ a posteriori, the largest of all) or `"baarda"` (σ a priori, each).
    - `significance`: α, two-sided: with `"pope"` the probability to lose anything of a network
      without blunders, with `"baarda"` that of one observation.
    - `limit`: at most so many removals.

    **Returns:** the problem without the removed observations, its solution, and what was removed
    in the order of removal.

    **Raises:** `InputError` for another test, or a level that is no probability.
    """
    check_test(test, significance)
    whole, removed, returned = problem, [], set()
    while True:
        values = adjust_from(problem, values)
        if problem.counts.redundancy < 2:
            return problem, values, removed
        found = Inspection(problem, values)
        counts = problem.counts
        tested = counts.observations + counts.control + counts.distances
        sigma0 = float(np.sqrt(found.vtpv / counts.redundancy))
        critical = critical_w(test, significance, tested, counts.redundancy, sigma0)
        room = len(removed) if limit is None else limit - len(removed)
        worst = _worst(problem, found, critical, sigma0)[: None if limit is None else max(room, 0)]
        if worst:
            removed += worst
            problem = without(problem, *worst)
            continue
        back = [r for r in _passing(whole, found, removed, critical) if r.row not in returned]
        if not back:
            return problem, values, removed
        returned |= {r.row for r in back}
        removed = [r for r in removed if r not in back]
        problem = without(whole, *removed)


def _worst(
    problem: Problem, found: Inspection, critical: float, sigma0: float
) -> list[Removed]:
    """What has to go now, the worst first."""
    w = found.reliability.w
    image = _finite(w.image).max(1, initial=0.0)
    most = {
        "image": image,
        "control": _finite(w.control).ravel(),
        "distance": _finite(w.distance),
    }
    kind = max(most, key=lambda kind: most[kind].max(initial=0.0))
    largest = most[kind].max(initial=0.0)
    if not largest > critical:
        return []
    rows = [int(most[kind].argmax())]
    if kind == "image":
        s = problem.structure
        candidates = np.flatnonzero(image > max(critical, TOGETHER * largest))
        candidates = candidates[np.argsort(-image[candidates], kind="stable")]
        by_image = np.unique(np.asarray(s.image)[candidates], return_index=True)[1]
        by_point = np.unique(np.asarray(s.point)[candidates], return_index=True)[1]
        rows = candidates[np.intersect1d(by_image, by_point)].tolist()
    scale = sigma0 if sigma0 > 0 else 1.0
    return [
        Removed(kind, row, _name(problem, kind, row), float(most[kind][row] / scale))
        for row in rows
    ]


def _passing(
    whole: Problem, found: Inspection, removed: Sequence[Removed], critical: float
) -> list[Removed]:
    """Removed observations that agree with the adjustment without them."""
    if not removed:
        return []
    tests = found.predicted_tests(whole.data)
    free = np.asarray(found.problem.structure.point_free).any(1)
    set_aside = np.asarray(whole.structure.point_free).any(1) & ~free
    value = {
        "image": np.where(
            set_aside[np.asarray(whole.structure.point)], np.inf, _finite(tests.image).max(1)
        ),
        "control": _finite(tests.control).ravel(),
        "distance": _finite(tests.distance),
    }
    return [r for r in removed if value[r.kind][r.row] < critical]


def _finite(tests) -> np.ndarray:
    """|tests|, 0 where there is none."""
    tests = np.abs(np.asarray(tests))
    return np.where(np.isfinite(tests), tests, 0.0)


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


def without(problem: Problem, *removed: Removed) -> Problem:
    """The problem with the weights of some observations set to zero, and lone tie points set
    aside."""
    s, data = problem.structure, problem.data
    rows = {kind: [r.row for r in removed if r.kind == kind]
            for kind in ("image", "control", "distance")}  # fmt: skip
    image, control = np.array(data.image_weight), np.array(data.control_weight)
    distance = np.array(data.distance_weight)
    image[rows["image"]] = 0.0
    control.reshape(-1)[rows["control"]] = 0.0
    distance[rows["distance"]] = 0.0

    point = np.asarray(s.point)
    rays = np.bincount(point, (image > 0).any(1), minlength=s.points)
    touched = np.unique(point[rows["image"]])
    tie = problem.network.points.has_role("tie")
    lone = np.setdiff1d(touched[(rays[touched] < 2) & tie[touched]], np.asarray(s.kept))
    if len(lone):
        image[np.isin(point, lone)] = 0.0
        s = eqx.tree_at(
            lambda s: (s.point_free, s.eliminated, s.datum_weight),
            dataclasses.replace(s, all_free=False),
            (
                s.point_free.at[lone].set(0.0),
                s.eliminated.at[lone].set(0.0),
                s.datum_weight.at[lone].set(0.0),
            ),
        )
    data = eqx.tree_at(
        lambda d: (d.image_weight, d.control_weight, d.distance_weight), data,
        tuple(map(jnp.asarray, (image, control, distance))),
    )  # fmt: skip
    return dataclasses.replace(
        problem, structure=s, data=data, counts=count_rows(s, data)
    )
