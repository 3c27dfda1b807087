"""Data snooping: remove blunders found by the test and adjust again, until none is left.

    |w|  > z(1 − α/2)                        Baarda (1968): each residual separately
    |τ|  > τ(1 − α'/2, redundancy)           Pope (1976): the largest of n, α' = 1 − (1 − α)^(1/n)

One blunder affects the residuals of its neighbours. Observations are removed together only if they
hardly affect each other (`separability.py`): of every eliminated row the worst; of a kept row (of
an image, say) those that stay significant whatever the influence of the worse ones; and of these
those at least half as bad as the worst of all. A row counts with the first kept row it touches, and
influence through other unknowns is neglected: what was removed wrongly passes the last test, and is
restored. Observations without an eliminated row, or with residuals tested individually, are removed
alone. An eliminated row left with too few residuals is excluded too, as
is one that its remaining observations do not determine, such as a point with two parallel rays.

If observations of a row are inseparable, as the two of a two-ray point, nothing decides which is
wrong: when no others are left, all of them are removed and listed as one ("either of").

Finally every removed observation is tested against the adjustment without it, by its predicted
residual v with variance σ²·(1 + h), and restored if it passes. Removed observations keep their rows
with weight zero, so nothing is compiled again.
"""

import dataclasses
from collections.abc import Callable, Iterable, Mapping, Sequence

import numpy as np
from jaxtyping import Float, Int

from jaxbundle.arguments import number, one_of
from jaxbundle.choices import TESTS
from jaxbundle.errors import NotSolvedError
from jaxbundle.leastsquares.indexing.rows import Values
from jaxbundle.leastsquares.problem import Problem, hold, with_data
from jaxbundle.leastsquares.quality.distributions import critical_w, normal_quantile
from jaxbundle.leastsquares.quality.names import eliminated_rows
from jaxbundle.leastsquares.quality.separability import choose_together, find_alternatives
from jaxbundle.leastsquares.quality.variance_components import ROUNDING_SIGMA
from jaxbundle.leastsquares.solution import Solution, take_step
from jaxbundle.leastsquares.whitening import has_weight, without_residual
from jaxbundle.types import AnyArray, not_none

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
    one_of(f"{option}snooping", test, TESTS, allow_none=True)
    number(f"{option}significance", significance, "a number between 0 and 1", lambda a: 0 < a < 1)


def readjust(problem: Problem, values: Values, adjust_from: Adjust) -> Solution:
    """The solution of a problem with slightly changed weights. A large one takes a single
    Gauss–Newton step if this decreases vᵀPv, with an error of the square of the change; for a small
    one compiling the step would take longer. A final result must be adjusted once more."""
    if sum(observation_set.number for observation_set in problem.observations) >= SINGLE_STEPS_FROM:
        current = Solution(problem, values)
        stepped = Solution(problem, take_step(problem, values))
        if stepped.vtpv <= current.vtpv:
            return stepped
    return adjust_from(problem, values)


def snoop(
    solution: Solution,
    adjust_from: Adjust,
    *,
    test: str = "pope",
    significance: float = 0.001,
    limit: int | None = None,
    doubtful: Sequence[RemovedRow] = (),
) -> tuple[Solution, list[RemovedRow]]:
    """Remove blunders, the worst first.

    **Arguments:**

    - `solution`: the one with all observations.
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
    full_problem = solution.problem
    touched_rows = _TouchedRows(full_problem)
    removed, restored = [*doubtful], set()
    excluded: set[int] = set()
    if removed:
        solution = solve_without(full_problem, removed, excluded, solution.values, adjust_from)
    # τ has f − 1 degrees of freedom.
    while solution.problem.counts.redundancy >= 2:
        if test == "pope" and solution.sigma0 < ROUNDING_SIGMA:
            break  # Exact data: nothing but rounding is tested against the rest of it.
        unit = _unit_of_tests(solution, test)
        counts = solution.problem.counts
        critical = critical_w(
            test,
            significance,
            touched_rows.tested(solution.problem),
            counts.redundancy,
            solution.sigma0,
        )
        critical_alone = normal_quantile(1 - significance / 2)
        worst = _worst(solution, touched_rows, unit, critical / unit, critical_alone)
        if worst and limit is not None:
            worst = worst[: max(limit - len(removed), 0)]
        if worst:
            removed += worst
        else:
            # What was restored once is not again: two that exclude each other would alternate
            # forever.
            passing = _passing(full_problem, solution, touched_rows, removed, critical) - restored
            still_removed = list(_without_passing(removed, passing))
            if still_removed == removed:
                break
            restored |= passing
            removed = still_removed
        readjust_from = lambda problem, values: readjust(problem, values, adjust_from)
        solution = solve_without(full_problem, removed, excluded, solution.values, readjust_from)
    if doubtful:
        # The tests of those that were doubtful from the beginning.
        unit = _unit_of_tests(solution, test)
        tested = _test_removed(full_problem, solution, touched_rows, removed)
        of_unknown = lambda r, tests: r.test if np.isfinite(r.test) else max(tests) / unit
        removed = [dataclasses.replace(r, test=of_unknown(r, tests)) for r, tests in tested]
    if removed:
        solution = solve_without(full_problem, removed, excluded, solution.values, adjust_from)
    return solution, removed


def _unit_of_tests(solution: Solution, test: str) -> float:
    """What normalised residuals w are divided by to give the values of a test."""
    return solution.sigma0 if test == "pope" and solution.sigma0 > 0 else 1.0


def solve_without(
    full_problem: Problem,
    removed: Sequence[RemovedRow],
    excluded: set[int],
    values: Values,
    adjust_from: Adjust,
) -> Solution:
    """The solution without removed observations and `excluded` eliminated rows, to which those are
    added that the remaining observations do not determine."""
    while True:
        try:
            return adjust_from(without(full_problem, removed, excluded), values)
        except NotSolvedError as error:
            newly_excluded = {*eliminated_rows(full_problem, error.undetermined)} - excluded
            if not newly_excluded:
                raise
            excluded |= newly_excluded


class _TouchedRows:
    """The rows touched by tested observations: by set the eliminated row of each (−1: none) and an
    index of its first kept row; and the sets whose rows, or single residuals, are removed."""

    def __init__(self, problem: Problem):
        self.eliminated = problem.plan.eliminated
        self.eliminated_row: dict[str, Int[np.ndarray, " n"]] = {}
        self.first_kept_row: dict[str, Int[np.ndarray, " n"]] = {}
        first_numbers = np.cumsum([0, *(t.rows for t in problem.tables)])
        start = {t.name: n for t, n in zip(problem.tables, first_numbers)}
        is_free = {t.name: t.free.any(1) for t in problem.tables}
        for observation_set in problem.observations:
            eliminated, first_kept = (
                np.full(observation_set.number, -1),
                np.full(observation_set.number, -1),
            )
            for name, rows in zip(observation_set.kind.of, observation_set.rows):
                if name == self.eliminated:
                    is_eliminated = is_free[name][rows] & ~problem.kept_rows[rows]
                    eliminated = np.where(is_eliminated, rows, eliminated)
                elif is_free[name].any():
                    first_kept = np.where(first_kept < 0, start[name] + rows, first_kept)
            self.eliminated_row[observation_set.name], self.first_kept_row[observation_set.name] = (
                eliminated,
                first_kept,
            )
        sets_with = lambda policy: [
            observation_set.name
            for observation_set in problem.observations
            if observation_set.kind.snooped == policy
        ]
        self.sets_removed_by_row = sets_with("whole")
        self.sets_removed_by_residual = sets_with("single")

    def tested(self, problem: Problem) -> int:
        """The number of tested residuals."""
        sets = (*self.sets_removed_by_row, *self.sets_removed_by_residual)
        weight = [problem.weights(o) for o in sets]
        return sum(int((w > 0).sum()) for w in weight)


@dataclasses.dataclass(frozen=True)
class _Candidates:
    """Rows of observations that may be removed: the set and row of each, and its largest test."""

    set: list[str]
    row: Int[np.ndarray, " n"]
    test: Float[np.ndarray, " n"]

    def take(self, by_set: Mapping[str, np.ndarray], positions: Iterable[int]) -> np.ndarray:
        """Values by set and row, of the candidates at these positions."""
        return np.array([by_set[self.set[k]][self.row[k]] for k in positions])


def _worst(
    solution: Solution,
    touched_rows: _TouchedRows,
    unit: float,
    critical: float,
    critical_alone: float,
) -> list[RemovedRow]:
    """The observations to remove now, the worst first; tests in `unit`.

    Observations of a row are separable if the test of the suspect exceeds `critical_alone` without
    the other."""
    tests = {o: _finite(w) / unit for o, w in solution.reliability.w.items()}
    single, joint = _find_candidates(tests, touched_rows)
    worst = max(single, key=lambda r: r.test, default=None)
    largest_single, largest_test = worst.test if worst else 0.0, joint.test.max(initial=0.0)
    # Observations without an eliminated row (control, distances) influence everything: alone.
    if worst and largest_single > max(critical, largest_test):
        return [worst]
    limit = max(critical, largest_single, REMOVED_TOGETHER * largest_test)
    positions = np.flatnonzero(joint.test > limit)
    if not len(positions):
        return []
    chosen_positions = positions[
        choose_together(
            joint.test[positions],
            joint.take(touched_rows.eliminated_row, positions),
            joint.take(touched_rows.first_kept_row, positions),
            joint.take(_leverage(solution), positions),
            critical,
        )
    ]
    neighbours = _Neighbours(solution, touched_rows, unit)
    alternatives = {
        k: neighbours.alternatives(joint.set[k], int(joint.row[k]), critical, critical_alone)
        for k in chosen_positions.tolist()
    }
    # Those beyond doubt first: without them, some of the others may become separable.
    certain = [k for k in alternatives if not alternatives[k]]
    return [
        RemovedRow(joint.set[k], int(joint.row[k]), None, float(joint.test[k]), alternatives[k])
        for k in certain or alternatives
    ]


def _find_candidates(
    tests: Mapping[str, Float[np.ndarray, "n r"]], touched_rows: _TouchedRows
) -> tuple[list[RemovedRow], _Candidates]:
    """Of every set the worst of those that are removed alone; and all rows with an eliminated row,
    which may be removed with others."""
    single_candidates = [
        RemovedRow(o, *divmod(int(t.argmax()), t.shape[1]), float(t.max()))
        for o, t in ((o, tests[o]) for o in touched_rows.sets_removed_by_residual)
        if t.size
    ]
    sets, rows, joint_tests = [], [np.zeros(0, int)], [np.zeros(0)]
    for o in (o for o in touched_rows.sets_removed_by_row if len(tests[o])):
        largest_test = tests[o].max(1, initial=0.0)
        has_none = touched_rows.eliminated_row[o] < 0
        without_eliminated_row = np.where(has_none, largest_test, 0.0)
        worst, test = without_eliminated_row.argmax(), without_eliminated_row.max(initial=0.0)
        single_candidates.append(RemovedRow(o, int(worst), None, float(test)))
        sets += [o] * len(largest_test)
        rows.append(np.arange(len(largest_test)))
        joint_tests.append(np.where(has_none, 0.0, largest_test))
    return single_candidates, _Candidates(sets, np.concatenate(rows), np.concatenate(joint_tests))


def _leverage(solution: Solution) -> dict[str, Float[np.ndarray, " n"]]:
    """(h − h_e)/(1 − h) of every observation, the largest of its residuals: its leverage h without
    the part h_e of its eliminated row, over its redundancy number."""
    # An observation without redundancy has no test (`reliability.MIN_REDUNDANCY`), and is no
    # candidate: `tiny` keeps its 0 out of the division.
    tested, tiny = solution.reliability, np.finfo(float).tiny
    kept_leverage = {
        o: np.clip(h - tested.eliminated_leverage[o], 0, None) for o, h in tested.hat.items()
    }
    redundancy = {o: np.maximum(1 - h, tiny) for o, h in tested.hat.items()}
    return {o: (kept_leverage[o] / redundancy[o]).max(1, initial=0.0) for o in kept_leverage}


class _Neighbours:
    """The observations of every eliminated row, to test their separability."""

    def __init__(self, solution: Solution, touched_rows: _TouchedRows, unit: float):
        self.solution, self.unit = solution, unit
        self.eliminated_row = touched_rows.eliminated_row
        # By set: the rows with weight in the order of their eliminated rows, and these.
        self.order, self.sorted = {}, {}
        for o, eliminated in touched_rows.eliminated_row.items():
            weighted = has_weight(np.asarray(solution.problem.data.weight[o])).any(1)
            rows = np.flatnonzero(weighted & (eliminated >= 0))
            self.order[o] = rows[np.argsort(eliminated[rows], kind="stable")]
            self.sorted[o] = eliminated[self.order[o]]

    def alternatives(
        self, o: str, row: int, critical: float, critical_alone: float
    ) -> tuple[int, ...]:
        """Inseparable rows of the same set and eliminated row."""
        eliminated = self.eliminated_row[o][row]
        bounds = [eliminated, eliminated + 1]
        rows = {
            s: self.order[s][slice(*np.searchsorted(self.sorted[s], bounds))]
            for s in (o, *(s for s in self.order if s != o))
        }
        E, v = self.solution.jacobian_eliminated, self.solution.residuals
        width = next(iter(E.values())).shape[2]
        design = np.concatenate([E[s][k].reshape(-1, width) for s, k in rows.items()])
        residual = np.concatenate([v[s][k].ravel() for s, k in rows.items()]) / self.unit
        size = v[o].shape[1]
        where = [np.arange(size) + size * i for i in range(len(rows[o]))]
        suspect = int(np.flatnonzero(rows[o] == row)[0])
        alternatives = find_alternatives(design, residual, where, suspect, critical, critical_alone)
        return tuple(rows[o][alternatives].tolist())


def _passing(
    full_problem: Problem,
    solution: Solution,
    touched_rows: _TouchedRows,
    removed: Sequence[RemovedRow],
    critical: float,
) -> set[tuple[str, int, int | None]]:
    """Sets, rows and residuals of removed observations that agree with the adjustment without
    them."""
    return {
        (r.set, row, r.residual)
        for r, tests in _test_removed(full_problem, solution, touched_rows, removed)
        for row, test in zip(r.rows, tests)
        if test < critical
    }


def _test_removed(
    full_problem: Problem,
    solution: Solution,
    touched_rows: _TouchedRows,
    removed: Sequence[RemovedRow],
) -> Iterable[tuple[RemovedRow, list[float]]]:
    """Each of the removed with the test of its rows against what remains; NaN in rows of an
    excluded eliminated row, which agrees with anything.

    Two residuals removed from one correlated observation are tested in separate passes, each
    without the other, which would predict it."""
    # Correlated observations of which single residuals were removed: [those of one row].
    of_one_row: dict[tuple[str, int], list[RemovedRow]] = {}

    def is_correlated(r: RemovedRow) -> bool:
        return r.residual is not None and full_problem.data.weight[r.set].ndim == 3

    for r in filter(is_correlated, removed):
        of_one_row.setdefault((r.set, r.row), []).append(r)

    def pass_of(r: RemovedRow) -> int:
        return of_one_row[r.set, r.row].index(r) if is_correlated(r) else 0

    is_held = np.zeros(0, bool)
    if touched_rows.eliminated is not None:
        free = lambda problem: problem.table(touched_rows.eliminated).free.any(1)
        is_held = free(full_problem) & ~free(solution.problem)

    def is_excluded(r: RemovedRow, row: int) -> bool:
        eliminated = touched_rows.eliminated_row[r.set][row]
        return bool(eliminated >= 0 and is_held[eliminated])

    for this_pass in sorted({pass_of(r) for r in removed}):
        tested = [r for r in removed if pass_of(r) == this_pass]
        same_rows = (of_one_row[r.set, r.row] for r in tested if is_correlated(r))
        removed_in_other_passes = [x for rows in same_rows for x in rows if pass_of(x) != this_pass]
        data = (
            without(full_problem, removed_in_other_passes).data
            if removed_in_other_passes
            else full_problem.data
        )
        tests = {o: _finite(t) for o, t in solution.predicted_tests(data).items()}
        for r in tested:
            residual = r.residual if r.residual is not None else slice(None)
            of_rows = np.max(tests[r.set][list(r.rows)][:, residual].reshape(len(r.rows), -1), 1)
            excluded = [is_excluded(r, row) for row in r.rows]
            yield r, np.where(excluded, np.nan, of_rows).tolist()


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
    e = problem.plan.eliminated
    undetermined: list[int] = []
    if e is not None and (removed or excluded):
        touched_rows, width = _TouchedRows(problem), problem.table(e).space.width
        residuals_left = np.zeros(problem.table(e).rows)
        for o, eliminated in touched_rows.eliminated_row.items():
            rows = has_weight(weight[o]).sum(1)
            np.add.at(residuals_left, eliminated[eliminated >= 0], rows[eliminated >= 0])
        # −1: no eliminated row.
        of_removed = ((touched_rows.eliminated_row[r.set], row) for r in removed for row in r.rows)
        changed = {int(eliminated[row]) for eliminated, row in of_removed} - {-1}
        undetermined = sorted({*excluded} | {row for row in changed if residuals_left[row] < width})
        for o, eliminated in touched_rows.eliminated_row.items():
            weight[o][np.isin(eliminated, undetermined)] = 0.0
    data = dataclasses.replace(problem.data, weight=weight)
    problem = with_data(problem, data)
    return hold(problem, not_none(e), undetermined) if undetermined else problem
