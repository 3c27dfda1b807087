"""Data snooping: remove blunders found by the test and adjust again, until none is left.

    |w|  > z(1 − α/2)                        Baarda (1968): each residual separately
    |τ|  > τ(1 − α'/2, redundancy)           Pope (1976): the largest of n, α' = 1 − (1 − α)^(1/n)

One blunder affects the residuals of its neighbours. So only observations that cannot mask each
other are removed together (`separation.py`): of every eliminated row only the worst, of a kept row
only those that stay significant whatever the influence of the worse ones, and only those at least
half as bad as the worst of all. Observations without an eliminated row, or with residuals tested
individually, are removed alone. An eliminated row left with too few residuals is excluded too, as
is one that its remaining observations do not determine, such as a point with two parallel rays.

If observations of a row are inseparable, as the two of a two-ray point, nothing decides which is
wrong: when no others are left, all of them are removed and listed as one ("either of").

Finally every removed observation is tested against the adjustment without it, by its predicted
residual v with variance σ²·(1 + h), and restored if it passes. Removed observations keep their rows
with weight zero, so nothing is compiled again.
"""

import dataclasses
from collections.abc import Callable, Iterable, Sequence

import numpy as np
from jaxtyping import Float, Int

from jaxbundle.arguments import number, one_of
from jaxbundle.choices import TESTS
from jaxbundle.errors import NotSolvedError
from jaxbundle.leastsquares.equations.separation import choose_together, find_alternatives
from jaxbundle.leastsquares.indexing.rows import Values
from jaxbundle.leastsquares.problem import Problem, hold, with_data
from jaxbundle.leastsquares.quality.distributions import critical_w, normal_quantile
from jaxbundle.leastsquares.quality.names import eliminated_rows
from jaxbundle.leastsquares.solution import Solution, take_step
from jaxbundle.leastsquares.whitening import used, without_residual
from jaxbundle.types import AnyArray, present

# Observations are removed together with the worst if their test is at least this fraction of its.
# Larger: more rounds of adjustments; smaller: good observations are removed for the blunders of
# others, and must be found again by the last test.
REMOVED_TOGETHER = 0.5
# Problems with at least this many observations take single steps between removals: below, the
# iterations of an adjustment (0.5 µs an observation each) take less time than compiling the step.
SINGLE_STEPS_FROM = 20_000

# The solution of a problem from start values; raises if there is none.
Adjust = Callable[[Problem, Values], Solution]


@dataclasses.dataclass(frozen=True)
class RemovedRow:
    """A removed observation: its set, row, residual (None: all) and test value, NaN where what
    remains cannot test it. `others`: rows of inseparable observations, removed with it."""

    set: str
    row: int
    residual: int | None
    test: float
    others: tuple[int, ...] = ()

    @property
    def rows(self) -> tuple[int, ...]:
        """All rows that were removed."""
        return (self.row, *self.others)


def check_test(test: str | None, significance: float, option: str = "") -> None:
    """Refuse an unknown test, and a level that is not a probability; `option` precedes the names in
    the message.

    **Raises:** `InputError`.
    """
    one_of(f"{option}snooping", test, TESTS, none=True)
    number(f"{option}significance", significance, "a number between 0 and 1", lambda a: 0 < a < 1)


def readjust(problem: Problem, values: Values, adjust_from: Adjust) -> Solution:
    """The solution of a problem with slightly changed weights. A large one takes a single
    Gauss–Newton step if this decreases vᵀPv, with an error of the square of the change; for a small
    one compiling the step would take longer. A final result must be adjusted once more."""
    if sum(given.number for given in problem.observations) >= SINGLE_STEPS_FROM:
        before = Solution(problem, values)
        after = Solution(problem, take_step(problem, values))
        if after.vtpv <= before.vtpv:
            return after
    return adjust_from(problem, values)


def snoop(
    found: Solution,
    adjust_from: Adjust,
    *,
    test: str = "pope",
    significance: float = 0.001,
    limit: int | None = None,
    doubtful: Sequence[RemovedRow] = (),
) -> tuple[Solution, list[RemovedRow]]:
    """Remove blunders, the worst first.

    **Arguments:**

    - `found`: the solution with all observations.
    - `adjust_from(problem, start)`: the solution of a changed problem.
    - `test`: `"pope"` (σ a posteriori, the largest of all) or `"baarda"` (σ a priori, each).
    - `significance`: α, two-sided: for `"pope"` the probability of removing anything from data
      without blunders, for `"baarda"` that of removing one residual. Observations of one eliminated
      row that are inseparable at this level are removed together.
    - `limit`: maximum number of removals.
    - `doubtful`: initially removed observations, restored if they pass in the end.

    **Returns:** the solution without the removed observations, and what was removed in the order
    of removal.

    **Raises:** `InputError` for an unknown test, or a level that is not a probability.
    """
    check_test(test, significance)
    whole, removed, returned = found.problem, [*doubtful], set()
    touched, excluded = _Touched(whole), set()
    if removed:
        found = _solve(whole, removed, excluded, found.values, adjust_from)
    # τ has f − 1 degrees of freedom.
    while found.problem.counts.redundancy >= 2:
        # Exact data have σ0 = 0, and residuals of rounding that no test may be scaled by.
        unit = found.sigma0 if test == "pope" and found.sigma0 > 0 else 1.0
        counts = found.problem.counts
        critical = critical_w(
            test, significance, touched.tested(found.problem), counts.redundancy, found.sigma0
        )
        worst = _worst(found, touched, unit, critical / unit, normal_quantile(1 - significance / 2))
        if worst and limit is not None:
            worst = worst[: max(limit - len(removed), 0)]
        if worst:
            removed += worst
        else:
            # What was restored once is not again: two that exclude each other would alternate
            # forever.
            passing = _passing(whole, found, touched, removed, critical) - returned
            kept = list(_without_passing(removed, passing))
            if kept == removed:
                break
            returned |= passing
            removed = kept
        again = lambda problem, values: readjust(problem, values, adjust_from)
        found = _solve(whole, removed, excluded, found.values, again)
    if doubtful:
        unit = found.sigma0 if test == "pope" and found.sigma0 > 0 else 1.0
        removed = list(_with_tests(whole, found, touched, removed, unit))
    if removed:
        found = _solve(whole, removed, excluded, found.values, adjust_from)
    return found, removed


def _solve(
    whole: Problem,
    removed: Sequence[RemovedRow],
    excluded: set[int],
    values: Values,
    adjust_from: Adjust,
) -> Solution:
    """The solution without removed observations and `excluded` eliminated rows, to which those are
    added that the remaining observations do not determine."""
    while True:
        try:
            return adjust_from(without(whole, removed, excluded), values)
        except NotSolvedError as error:
            more = {*eliminated_rows(whole, error.undetermined)} - excluded
            if not more:
                raise
            excluded |= more


class _Touched:
    """The rows touched by tested observations: by set the eliminated row of each (−1: none) and an
    index of its first kept row; `whole`: sets whose observations are removed as a whole."""

    def __init__(self, problem: Problem):
        self.eliminated = problem.plan.eliminated
        self.own: dict[str, Int[np.ndarray, " n"]] = {}
        self.shared: dict[str, Int[np.ndarray, " n"]] = {}
        first = np.cumsum([0, *(t.rows for t in problem.tables)])
        start = {t.name: n for t, n in zip(problem.tables, first)}
        moves = {t.name: t.free.any(1) for t in problem.tables}
        stays = problem.kept_rows
        for given in problem.observations:
            own, shared = np.full(given.number, -1), np.full(given.number, -1)
            for name, rows in zip(given.kind.of, given.rows):
                if name == self.eliminated:
                    own = np.where(moves[name][rows] & ~stays[rows], rows, own)
                elif moves[name].any():
                    shared = np.where(shared < 0, start[name] + rows, shared)
            self.own[given.name], self.shared[given.name] = own, shared
        chosen = lambda policy: [
            given.name for given in problem.observations if given.kind.snooped == policy
        ]
        self.whole, self.single = chosen("whole"), chosen("single")

    def tested(self, problem: Problem) -> int:
        """The number of tested residuals."""
        weight = [problem.weights(o) for o in (*self.whole, *self.single)]
        return sum(int((w > 0).sum()) for w in weight)


def _worst(
    found: Solution, touched: _Touched, unit: float, critical: float, apart: float
) -> list[RemovedRow]:
    """The observations to remove now, the worst first; tests in `unit`.

    Observations of a row are separable if the test of the suspect exceeds `apart` without the
    other."""
    tests = {o: _finite(w) / unit for o, w in found.reliability.w.items()}
    alone = [
        RemovedRow(o, *divmod(int(t.argmax()), t.shape[1]), float(t.max()))
        for o, t in ((o, tests[o]) for o in touched.single)
        if t.size
    ]
    together, of, row = [], [], []
    for o in filter(lambda o: len(tests[o]), touched.whole):
        of_one = tests[o].max(1, initial=0.0)
        lonely = np.where(touched.own[o] < 0, of_one, 0.0)
        alone.append(RemovedRow(o, int(lonely.argmax()), None, float(lonely.max(initial=0.0))))
        together.append(np.where(touched.own[o] < 0, 0.0, of_one))
        of.append(np.full(len(of_one), o, dtype=object))
        row.append(np.arange(len(of_one)))
    together, of, row = (np.concatenate([*x, []]) for x in (together, of, row))
    row = row.astype(int)
    worst = max(alone, key=lambda r: r.test, default=None)
    other, largest = worst.test if worst else 0.0, together.max(initial=0.0)
    # Observations without an eliminated row (control, distances) influence everything: alone.
    if worst and other > max(critical, largest):
        return [worst]
    at = np.flatnonzero(together > max(critical, other, REMOVED_TOGETHER * largest))
    if not len(at):
        return []
    pick = lambda by_set: np.array([by_set[o][k] for o, k in zip(of[at], row[at])])
    chosen = at[
        choose_together(
            together[at],
            pick(touched.own),
            pick(touched.shared),
            pick(_leverage(found)),
            critical,
        )
    ]
    neighbours = _Neighbours(found, touched, unit)
    others = {
        k: neighbours.alternatives(str(of[k]), int(row[k]), critical, apart)
        for k in chosen.tolist()
    }
    # Those beyond doubt first: without them, some of the others may become separable.
    certain = [k for k in others if not others[k]]
    return [
        RemovedRow(str(of[k]), int(row[k]), None, float(together[k]), others[k])
        for k in certain or others
    ]


def _leverage(found: Solution) -> dict[str, Float[np.ndarray, " n"]]:
    """(h − h_e)/(1 − h) of every observation, the largest of its residuals: its leverage h without
    the part h_e of its eliminated row, over its redundancy number."""
    tested, tiny = found.reliability, np.finfo(float).tiny
    return {
        o: (np.clip(h - tested.own[o], 0.0, None) / np.maximum(1 - h, tiny)).max(1, initial=0.0)
        for o, h in tested.hat.items()
    }


class _Neighbours:
    """The observations of every eliminated row, to test their separability."""

    def __init__(self, found: Solution, touched: _Touched, unit: float):
        self.found, self.unit, self.sets = found, unit, touched.own
        self.order, self.sorted = {}, {}
        for o, own in touched.own.items():
            weighted = used(np.asarray(found.problem.data.weight[o])).any(1)
            rows = np.flatnonzero(weighted & (own >= 0))
            self.order[o] = rows[np.argsort(own[rows], kind="stable")]
            self.sorted[o] = own[self.order[o]]

    def alternatives(self, o: str, row: int, critical: float, apart: float) -> tuple[int, ...]:
        """Inseparable rows of the same set and eliminated row."""
        own = self.sets[o][row]
        rows = {
            s: self.order[s][slice(*np.searchsorted(self.sorted[s], [own, own + 1]))]
            for s in (o, *(s for s in self.sets if s != o))
        }
        E, v = self.found.by_eliminated, self.found.residuals
        width = next(iter(E.values())).shape[2]
        design = np.concatenate([E[s][k].reshape(-1, width) for s, k in rows.items()])
        residual = np.concatenate([v[s][k].ravel() for s, k in rows.items()]) / self.unit
        size = v[o].shape[1]
        where = [np.arange(size) + size * i for i in range(len(rows[o]))]
        suspect = int(np.flatnonzero(rows[o] == row)[0])
        alternatives = find_alternatives(design, residual, where, suspect, critical, apart)
        return tuple(rows[o][alternatives].tolist())


def _passing(
    whole: Problem,
    found: Solution,
    touched: _Touched,
    removed: Sequence[RemovedRow],
    critical: float,
) -> set[tuple[str, int, int | None]]:
    """Sets, rows and residuals of removed observations that agree with the adjustment without
    them."""
    return {
        (r.set, row, r.residual)
        for r, tests in _test_removed(whole, found, touched, removed)
        for row, test in zip(r.rows, tests)
        if test < critical
    }


def _with_tests(
    whole: Problem,
    found: Solution,
    touched: _Touched,
    removed: Sequence[RemovedRow],
    unit: float,
) -> Iterable[RemovedRow]:
    """What was removed, with the tests of initially doubtful observations, in `unit`."""
    for r, tests in _test_removed(whole, found, touched, removed):
        yield r if np.isfinite(r.test) else dataclasses.replace(r, test=max(tests) / unit)


def _test_removed(
    whole: Problem, found: Solution, touched: _Touched, removed: Sequence[RemovedRow]
) -> Iterable[tuple[RemovedRow, list[float]]]:
    """Each of the removed with the test of its rows against what remains; NaN in rows of an
    excluded eliminated row, which agrees with anything.

    Two residuals removed from one correlated observation are tested in separate passes, each
    without the other, which would predict it."""
    correlated = lambda r: r.residual is not None and whole.data.weight[r.set].ndim == 3
    together: dict[tuple[str, int], list[RemovedRow]] = {}
    for r in filter(correlated, removed):
        together.setdefault((r.set, r.row), []).append(r)
    others = lambda r: [x for x in together[r.set, r.row] if x is not r] if correlated(r) else []
    place = lambda r: together[r.set, r.row].index(r) if correlated(r) else 0
    aside = np.zeros(0, bool)
    if touched.eliminated is not None:
        free = lambda problem: problem.table(touched.eliminated).free.any(1)
        aside = free(whole) & ~free(found.problem)
    excluded = lambda r, row: touched.own[r.set][row] >= 0 and aside[touched.own[r.set][row]]
    for turn in sorted({place(r) for r in removed}):
        of = [r for r in removed if place(r) == turn]
        rest = [x for r in of for x in others(r)]
        data = without(whole, rest).data if rest else whole.data
        tests = {o: _finite(t) for o, t in found.predicted_tests(data).items()}
        for r in of:
            residual = r.residual if r.residual is not None else slice(None)
            of_rows = np.max(tests[r.set][list(r.rows)][:, residual].reshape(len(r.rows), -1), 1)
            yield r, np.where([excluded(r, row) for row in r.rows], np.nan, of_rows).tolist()


def _remove(weight: Float[np.ndarray, "n ..."], removed: RemovedRow) -> None:
    """Take the weight of what is removed."""
    rows = list(removed.rows)
    if removed.residual is None:
        weight[rows] = 0.0
    elif weight.ndim == 2:
        weight[rows, removed.residual] = 0.0
    else:
        weight[rows] = [without_residual(weight[row], removed.residual) for row in rows]


def _without_passing(
    removed: Sequence[RemovedRow], passing: set[tuple[str, int, int | None]]
) -> Iterable[RemovedRow]:
    """The observations that stay removed. If all inseparable ones pass individually, they still
    contradict each other and all stay removed."""
    for r in removed:
        stay = tuple(row for row in r.rows if (r.set, row, r.residual) not in passing)
        if stay == r.rows or (not stay and r.others):
            yield r
        elif stay:
            yield dataclasses.replace(r, row=stay[0], others=stay[1:])


def _finite(tests: Float[AnyArray, "..."]) -> Float[np.ndarray, "..."]:
    """|tests|, 0 if there is none."""
    tests = np.abs(np.asarray(tests))
    return np.where(np.isfinite(tests), tests, 0.0)


def without(
    problem: Problem, removed: Sequence[RemovedRow], excluded: Iterable[int] = ()
) -> Problem:
    """The problem with the weights of removed observations set to zero, without `excluded`
    eliminated rows and those left with too few residuals."""
    weight = {o: np.array(w) for o, w in problem.data.weight.items()}
    for r in removed:
        _remove(weight[r.set], r)
    e, lone = problem.plan.eliminated, []
    if e is not None and (removed or excluded):
        touched, width = _Touched(problem), problem.table(e).space.width
        left = np.zeros(problem.table(e).rows)
        for o, own in touched.own.items():
            rows = used(weight[o]).sum(1)
            np.add.at(left, own[own >= 0], rows[own >= 0])
        # −1: no eliminated row.
        changed = {int(touched.own[r.set][row]) for r in removed for row in r.rows} - {-1}
        lone = sorted({*excluded} | {row for row in changed if left[row] < width})
        for o, own in touched.own.items():
            weight[o][np.isin(own, lone)] = 0.0
    data = dataclasses.replace(problem.data, weight=weight)
    problem = with_data(problem, data)
    return hold(problem, present(e), lone) if lone else problem
