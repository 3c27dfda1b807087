"""Data snooping: remove what the test calls a blunder, adjust again, until nothing is worse.

    |w|  > z(1 − α/2)                        Baarda (1968): each observation by itself
    |τ|  > τ(1 − α'/2, redundancy)           Pope (1976): the largest of n, α' = 1 − (1 − α)^(1/n)

One blunder spoils the residuals of its neighbours. So only what cannot mask each other goes at a
time (`separation.py`): of every point only the worst ray, of an image only rays that stay
significant whatever the worse ones there put into their tests, and only rays at least half as bad
as the worst of all; a control coordinate or a distance goes alone. An image point goes with both of
its coordinates; a tie point that is left with one ray goes too. Where rays of a point cannot be
told apart, as the two of a point that has no more, nothing says which is wrong: when nothing else
is left, all of them go and stand in the list as one ("either of").

In the end whatever was removed is held against the adjustment it took no part in, by its predicted
residual v and the variance σ²·(1 + h) of that: what passes comes back. Removed observations keep
their rows with weight zero, so nothing is compiled again.
"""

import dataclasses
from collections.abc import Iterable, Sequence

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from jaxbundle.adjustment.jacobian import compiled_jacobian
from jaxbundle.adjustment.problem import Problem, count_rows
from jaxbundle.arguments import number, one_of
from jaxbundle.statistics.distributions import critical_w, normal_quantile
from jaxbundle.statistics.inspection import Inspection
from jaxbundle.statistics.readjusting import Adjust, readjust
from jaxbundle.statistics.separation import choose_together, find_alternatives

TOGETHER = 0.5
"""Rays are removed together with the worst one if their test is at least this part of its."""


@dataclasses.dataclass(frozen=True)
class Removed:
    """A removed observation: its kind, row in the arrays, a name for people, its test value.

    `others`: rows of observations that may be the wrong ones instead, removed with it.
    """

    kind: str
    row: int
    name: str
    test: float
    others: tuple[int, ...] = ()

    @property
    def rows(self) -> tuple[int, ...]:
        """All rows that were removed."""
        return (self.row, *self.others)


TESTS = ("pope", "baarda")


def check_test(test: str | None, significance: float, option: str = "") -> None:
    """Refuse a test that is none, and a level that is no probability; `option` stands before the
    names in the message.

    **Raises:** `InputError`.
    """
    one_of(f"{option}snooping", test, TESTS, none=True)
    number(f"{option}significance", significance, "a number between 0 and 1", lambda a: 0 < a < 1)


def snoop(
    found: Inspection,
    adjust_from: Adjust,
    *,
    test: str = "pope",
    significance: float = 0.001,
    limit: int | None = None,
) -> tuple[Inspection, list[Removed]]:
    """Remove blunders, the worst first.

    **Arguments:**

    - `found`: the solution with all observations.
    - `adjust_from(problem, start)`: the solution of a changed problem.
    - `test`: `"pope"` (σ a posteriori, the largest of all) or `"baarda"` (σ a priori, each).
    - `significance`: α, two-sided: with `"pope"` the probability to lose anything of a network
      without blunders, with `"baarda"` that of one observation. Rays of a point that cannot be told
      apart at this level are removed together.
    - `limit`: at most so many removals.

    **Returns:** the solution without the removed observations, and what was removed in the order
    of removal.

    **Raises:** `InputError` for another test, or a level that is no probability.
    """
    check_test(test, significance)
    whole, removed, returned = found.problem, [], set()
    while found.problem.counts.redundancy >= 2:
        unit = _unit(found, test)
        critical = _critical(found, test, significance) / unit
        worst = _worst(found, unit, critical, normal_quantile(1 - significance / 2))
        if worst and limit is not None:
            worst = worst[: max(limit - len(removed), 0)]
        if worst:
            removed += worst
        else:
            passing = _passing(whole, found, removed, critical * unit) - returned
            kept = list(_without_passing(whole, removed, passing))
            if kept == removed:
                break
            returned |= passing
            removed = kept
        found = readjust(without(whole, *removed), found.adjusted, adjust_from)
    return adjust_from(found.problem, found.adjusted) if removed else found, removed


def _unit(found: Inspection, test: str) -> float:
    """What tests are divided by: σ0 a posteriori for Pope's."""
    sigma0 = float(np.sqrt(found.vtpv / found.problem.counts.redundancy))
    return sigma0 if test == "pope" and sigma0 > 0 else 1.0


def _critical(found: Inspection, test: str, significance: float) -> float:
    """The greatest |w| that is no blunder."""
    counts = found.problem.counts
    tested = counts.observations + counts.control + counts.distances
    sigma0 = float(np.sqrt(found.vtpv / counts.redundancy))
    return critical_w(test, significance, tested, counts.redundancy, sigma0)


def _worst(found: Inspection, unit: float, critical: float, apart: float) -> list[Removed]:
    """What has to go now, the worst first; tests in `unit`.

    Rays of a point are told apart if the test of the suspect exceeds `apart` without the other."""
    problem, w = found.problem, found.reliability.w
    image = _finite(w.image).max(1, initial=0.0) / unit
    alone = {"control": _finite(w.control).ravel(), "distance": _finite(w.distance)}
    kind = max(alone, key=lambda kind: alone[kind].max(initial=0.0))
    other, largest = alone[kind].max(initial=0.0) / unit, image.max(initial=0.0)
    if other > max(critical, largest):
        row = int(alone[kind].argmax())
        return [Removed(kind, row, name_of(problem, kind, row), float(other))]
    candidates = np.flatnonzero(image > max(critical, other, TOGETHER * largest))
    if not len(candidates):
        return []
    rays = _Rays(found, unit)
    chosen = candidates[choose_together(
        image[candidates], rays.point[candidates], rays.image[candidates],
        rays.leverage(candidates), critical,
    )]  # fmt: skip
    others = {row: rays.alternatives(row, critical, apart) for row in chosen.tolist()}
    certain = [row for row in others if not others[row]]
    return [
        Removed("image", row, name_of(problem, "image", row, *others[row]), float(image[row]),
                others[row])
        for row in certain or others
    ]  # fmt: skip


class _Rays:
    """Image points as the rules of `separation.py` see them: rows of their point, in a block of
    their image."""

    def __init__(self, found: Inspection, unit: float):
        s, data = found.problem.structure, found.problem.data
        self.found, self.unit = found, unit
        self.image, self.point = np.asarray(s.image), np.asarray(s.point)
        jacobian = compiled_jacobian(found.structure, found.values, found.data)
        self.by_point = np.asarray(jacobian.point)[: len(self.point)]
        used = np.flatnonzero((np.asarray(data.image_weight) > 0).any(1))
        self.order = used[np.argsort(self.point[used], kind="stable")]
        self.control = dict(zip(np.asarray(s.control).tolist(), np.asarray(data.control_weight)))

    def leverage(self, rows: np.ndarray) -> np.ndarray:
        """h̃/r, the larger one of both coordinates: h less what the own point has in it."""
        r = np.asarray(self.found.reliability.redundancy.image)[rows]
        inverse = np.asarray(self.found.factor.point)[self.point[rows]]
        eliminated = np.asarray(self.found.structure.eliminated)[self.point[rows]]
        own = np.einsum("nij,naj->nai", inverse, self.by_point[rows] * eliminated[:, None])
        h = np.clip(1 - r - (own**2).sum(2), 0.0, None)
        return (h / np.maximum(r, np.finfo(float).tiny)).max(1, initial=0.0)

    def alternatives(self, row: int, critical: float, apart: float) -> tuple[int, ...]:
        """Rays of the same point that may be wrong instead."""
        p = self.point[row]
        ends = np.searchsorted(self.point[self.order], [p, p + 1])
        rays = self.order[slice(*ends)]
        v = np.asarray(self.found.reliability.residual.image)[rays].ravel() / self.unit
        design = self.by_point[rays].reshape(-1, 3)
        if p in self.control:
            design = np.concatenate([design, np.diag(self.control[p])])
        where = [np.array([2 * i, 2 * i + 1]) for i in range(len(rays))]
        suspect = int(np.flatnonzero(rays == row)[0])
        found = find_alternatives(design, v, where, suspect, critical, apart)
        return tuple(rays[found].tolist())


def _passing(
    whole: Problem, found: Inspection, removed: Sequence[Removed], critical: float
) -> set[tuple[str, int]]:
    """Kinds and rows of removed observations that agree with the adjustment without them."""
    if not removed:
        return set()
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
    return {(r.kind, row) for r in removed for row in r.rows if value[r.kind][row] < critical}


def _without_passing(
    whole: Problem, removed: Sequence[Removed], passing: set[tuple[str, int]]
) -> Iterable[Removed]:
    """What stays removed. Where all that may be wrong pass one by one, they still contradict each
    other, and all of them stay away."""
    for r in removed:
        stay = tuple(row for row in r.rows if (r.kind, row) not in passing)
        if stay == r.rows or (not stay and r.others):
            yield r
        elif stay:
            yield Removed(r.kind, stay[0], name_of(whole, r.kind, *stay), r.test, stay[1:])


def _finite(tests) -> np.ndarray:
    """|tests|, 0 where there is none."""
    tests = np.abs(np.asarray(tests))
    return np.where(np.isfinite(tests), tests, 0.0)


def name_of(problem: Problem, kind: str, row: int, *others: int) -> str:
    """An observation in words, or several of which either may be wrong."""
    if others:
        names = [name_of(problem, kind, one) for one in (row, *others)]
        return f"either of {', '.join(names[:-1])} or {names[-1]}"
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
    rows = {kind: [row for r in removed if r.kind == kind for row in r.rows]
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
