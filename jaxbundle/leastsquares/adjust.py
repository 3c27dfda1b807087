"""`adjust`: from tables and observations to a result with statistics.

from jaxbundle import leastsquares as ls

height = ls.Table("height", start)                                                   # [n]
levelled = ls.Kind("levelled difference", lambda a, b, dh: b - a - dh, of=("height", "height"))
result = ls.adjust([height], [levelled(rows=(i, j), measured=dh, sigma=s)], datum="inner")
result.sigma0, result["height"].value, result["height"].sigma
"""

import dataclasses
import functools
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax
import numpy as np
from jaxtyping import Array, Float, PyTree

from jaxbundle.arguments import integer, one_of, truth
from jaxbundle.choices import ESTIMATORS, METHODS
from jaxbundle.display import print_in_one_screen
from jaxbundle.errors import InputError, NotSolvedError
from jaxbundle.leastsquares.datum.motions import likely_motions
from jaxbundle.leastsquares.declarations import Motions, ObservationSet, Table, row_numbers
from jaxbundle.leastsquares.indexing.reduction import FACTORS
from jaxbundle.leastsquares.indexing.rows import Values
from jaxbundle.leastsquares.iterations.search import SEARCHES
from jaxbundle.leastsquares.iterations.solver import Minimum
from jaxbundle.leastsquares.iterations.stopping import SINGULAR, TERMINATIONS, converged
from jaxbundle.leastsquares.problem import Problem, SystemCounts, make_problem, with_factor
from jaxbundle.leastsquares.quality.nondifferentiable import without_derivatives
from jaxbundle.leastsquares.quality.null_space import undetermined_unknowns
from jaxbundle.leastsquares.quality.reliability import external_reliability, minimal_detectable
from jaxbundle.leastsquares.quality.robust import SuspectRow, reweight
from jaxbundle.leastsquares.quality.snooping import RemovedRow, check_test, snoop
from jaxbundle.leastsquares.quality.variance_components import (
    Component,
    VarianceGroup,
    estimate,
    variance_components,
)
from jaxbundle.leastsquares.solution import Solution, find_minimum
from jaxbundle.types import AnyArray

DATUMS = ("given", "inner", "minimal")


@print_in_one_screen
@dataclasses.dataclass(frozen=True)
class TableResult:
    """A table after the adjustment: `value` in the given form; `sigma` a posteriori and
    `covariance` of the directions of a row, [rows, width] ([rows] for a table of numbers) and
    [rows, width, width]; 0 for held unknowns."""

    value: PyTree[np.ndarray]
    sigma: Float[np.ndarray, "rows *width"]
    covariance: Float[np.ndarray, "rows width width"]


def table_result(solution: Solution, table: str, sigma0: float) -> TableResult:
    """A table of a solution."""
    value = jax.tree.map(np.asarray, solution.values[table])
    covariance = sigma0**2 * solution.cofactor(table)
    sigma = np.sqrt(np.clip(np.diagonal(covariance, axis1=1, axis2=2), 0, None))
    numbers = isinstance(value, np.ndarray) and value.ndim == 1
    return TableResult(value, sigma[:, 0] if numbers else sigma, covariance)


class Result:
    """An adjusted problem; check `converged` first.

    `converged`, `termination`, `iterations`, `sigma0`, `vtpv`, `counts` (observations, unknowns,
    datum, redundancy); `result[table]`; `residuals(kind)`; `covariance(function)`; `removed`,
    `suspects`, `components`; `undetermined`, names of undetermined unknowns; `unsettled`, what of
    robust weights and variance components was still changing when its rounds ended.

    Statistics of problems too large for a factor raise an `InputError`; `minimum.values` has the
    tables.
    """

    def __init__(
        self,
        problem: Problem,
        minimum: Minimum[Values],
        removed: Sequence[RemovedRow] = (),
        suspects: Sequence[SuspectRow] = (),
        factors: Mapping[str, float] | None = None,
        unsettled: Sequence[str] = (),
    ):
        self.problem, self.minimum = problem, minimum
        self.removed, self.suspects = tuple(removed), tuple(suspects)
        self.sigma_factors, self.unsettled = dict(factors or {}), tuple(unsettled)

    @property
    def termination(self) -> str:
        """Why the iterations ended, in words."""
        reason = int(self.minimum.termination)
        return TERMINATIONS[SINGULAR if converged(reason) and not self.converged else reason]

    @property
    def iterations(self) -> int:
        """Steps tried, including rejected ones, without the evaluation of the start."""
        return max(int(self.minimum.iterations) - 1, 0)

    @functools.cached_property
    def converged(self) -> bool:
        """Whether a minimum was reached and all unknowns are determined."""
        return bool(converged(int(self.minimum.termination))) and self._solution.determined

    @functools.cached_property
    def undetermined(self) -> tuple[str, ...]:
        """Undetermined unknowns, most affected first; empty for a solved problem."""
        return (
            ()
            if self.converged
            else tuple(undetermined_unknowns(self.problem, self.minimum.values))
        )

    @functools.cached_property
    def _solution(self) -> Solution:
        return Solution(self.problem, self.minimum.values)

    @property
    def solution(self) -> Solution:
        """The inspection of the solution, for statistics.

        **Raises:** `NotSolvedError` if there is none."""
        if not self.converged:
            raise NotSolvedError(self._failure, list(self.undetermined))
        return self._solution

    @property
    def _factored(self) -> Solution:
        """The solution with a factor to read covariances from."""
        solution = self.solution
        if not self._has_factor:
            raise InputError(
                "the problem is too large for its statistics: use a part of it; the adjusted "
                "tables are in `minimum.values`"
            )
        return solution

    @property
    def _has_factor(self) -> bool:
        return self.problem.plan.reduction in FACTORS

    @functools.cached_property
    def _failure(self) -> str:
        """Why there is no solution: the undetermined unknowns, or observations without
        derivatives."""
        fault, names = "not determined", self.undetermined
        if not names:
            sets = [observation_set.name for observation_set in self.problem.observations]
            names = tuple(without_derivatives(self.problem, self.minimum.values, sets))
            fault = "no finite residual or derivative of"
        return f"not solved: {self.termination}" + (
            f"; {fault}: {', '.join(names[:8])}" if names else ""
        )

    @property
    def counts(self) -> SystemCounts:
        """Observations, unknowns, datum conditions, redundancy."""
        return self.problem.counts

    @property
    def vtpv(self) -> float:
        """vᵀPv of all observations."""
        return self.solution.vtpv

    @property
    def sigma0(self) -> float:
        """√(vᵀPv/redundancy); NaN without redundancy."""
        return self.solution.sigma0

    def __getitem__(self, table: str) -> TableResult:
        if table not in self.minimum.values:
            raise KeyError(f"there is no table {table!r}; known: {', '.join(self.minimum.values)}")
        return table_result(self._factored, table, self.sigma0)

    def redundancy(self, kind: str) -> Float[np.ndarray, "n *r"]:
        """The redundancy numbers of the observations of a kind, in the given order."""
        return self.residuals(kind)["r"]

    def residuals(self, kind: str) -> dict[str, Float[np.ndarray, "n *r"]]:
        """For the observations of a kind, in the given order: v (computed − observed) and sigma (a
        priori) in the unit of the kind, r, w (Baarda), tau (Pope), mdb, external; v is NaN, sigma
        infinite for residuals without weight."""
        names = {
            observation_set.name: observation_set.kind.name
            for observation_set in self.problem.observations
        }
        if kind not in names.values():
            kinds = ", ".join(dict.fromkeys(names.values()))
            raise KeyError(f"there is no kind {kind!r}; known: {kinds}")
        parts = [self._residuals(o) for o, name in names.items() if name == kind]
        columns = {c: np.concatenate([part[c] for part in parts]) for c in parts[0]}
        is_single = columns["v"].shape[1] == 1
        return {c: x[:, 0] if is_single else x for c, x in columns.items()}

    def _residuals(self, o: str) -> dict[str, Float[AnyArray, "n r"]]:
        reliability, weight = self._factored.reliability, self.problem.weights(o)
        has_weight = weight > 0
        # The inner `where` keeps 1/0 out of the unused branch.
        sigma = np.where(has_weight, 1 / np.where(has_weight, weight, 1.0), np.inf)
        w, gain = reliability.w[o], np.where(has_weight, reliability.gain[o], 1.0)
        redundancy = np.where(has_weight, np.clip(1 - reliability.hat[o], 0, 1), 0.0)
        return {
            "v": reliability.residual[o] * np.where(has_weight, sigma, np.nan),
            "sigma": sigma,
            "r": reliability.redundancy[o],
            "w": w,
            "tau": w / (self.sigma0 or np.nan),
            "mdb": minimal_detectable(sigma / gain, redundancy),
            "external": external_reliability(redundancy),
        }

    @functools.cached_property
    def components(self) -> dict[str, Component]:
        """Variance components of the kinds of observations."""
        groups = kinds_as_groups(self.problem)
        return variance_components(self._factored, groups, self.sigma_factors)

    def covariance(self, function: Callable[[Values], Array]) -> Float[np.ndarray, "n n"]:
        """The covariance of any differentiable function of the tables (name → values) → [n]."""
        return self.sigma0**2 * self.solution.propagate(function)

    def __str__(self) -> str:
        if not self.converged:
            return self._failure
        n = self.counts
        lines = [
            f"solved in {self.iterations} iterations: {self.termination}",
            f"{n.observations} observations, {n.unknowns} unknowns, datum defect {n.datum}, "
            f"redundancy {n.redundancy}, sigma0 {self.sigma0:.4g}",
        ]
        if self.unsettled:
            lines.append(f"not settled: {', '.join(self.unsettled)}")
        if not self._has_factor:
            return "\n".join([*lines, "too large for statistics"])
        lines.append(f"{'kind':32}{'number':>8}{'redundancy':>12}{'sigma/given':>17}")
        lines += [
            f"{name:32}{c.observations:8d}{c.redundancy:12.2f}{c.sigma:17.4g}"
            for name, c in self.components.items()
        ]
        return "\n".join(lines)


def adjust(  # noqa: PLR0913 - the options of an adjustment
    tables: Sequence[Table],
    observations: Sequence[ObservationSet],
    *,
    datum: str | Mapping[str, Any] = "given",
    motions: Motions | None = None,
    eliminate: str | None = "",
    reduction: str | None = None,
    method: str = "levenberg-marquardt",
    max_iterations: int = 100,
    robust: str | None = None,
    snooping: str | None = None,
    significance: float = 0.001,
    estimate_components: bool = False,
    progress: Callable | None = None,
    **options: Any,
) -> Result:
    """Adjust your own problem by least squares.

    **Arguments:**

    - `tables`: the unknowns; `observations`: sets of them, made by calling a `Kind`.
    - `datum`: for a problem that may float as a whole: `"given"`, defined by the observations and
      held unknowns; `"inner"`, inner constraints on all unknowns; `"minimal"`, as few held unknowns
      as needed; or datum rows by table, with inner constraints on these.
    - `motions`: in which the problem may float; default: a similarity of all tables of coordinates
      and poses (a shift of a table of numbers), see `motions.py`. The open ones are determined
      from the observations.
    - `eliminate`: the table that is eliminated row by row; default: automatic; None: none.
    - `reduction`: solver of the reduced system, "dense", "banded" or "iterative"; default:
      automatic.
    - `method`: "levenberg-marquardt" or "gauss-newton".
    - `robust`: "huber", "cauchy" or "tukey"; `snooping`: "pope" or "baarda", at the level
      `significance`.
    - `estimate_components`: scale the σ of every kind until its variance component is 1.
    - `progress(step, cost, λ)`: called for every evaluation; of up to 200 000 observations only
      when the iterations have ended.

    **Returns:** a `Result`.

    **Raises:** `InputError` for inconsistent declarations; `NotSolvedError` if the problem is not
    determined after robust estimation, snooping or variance components.
    """
    one_of("method", method, METHODS)
    one_of("robust", robust, ESTIMATORS, allow_none=True)
    truth("estimate_components", estimate_components)
    check_test(snooping, significance)
    # One more: the first evaluation is of the start values.
    steps = integer("max_iterations", max_iterations) + 1
    if robust and snooping:
        raise InputError("robust estimation or data snooping, not both at once")
    tables = tuple(tables)
    eliminate = choose_eliminated(tables, observations) if eliminate == "" else eliminate
    problem = make_problem(
        tables,
        observations,
        eliminate,
        motions=_choose_motions(tables, datum, motions),
        datum=functools.partial(_hold_datum, tables, datum),
        reduction=reduction,
        **options,
    )
    minima: list[Minimum[Values]] = []

    def minimise_again(problem: Problem, start: Values) -> Solution:
        minima.append(
            find_minimum(
                problem,
                start,
                search=SEARCHES[method],
                max_steps=steps,
                progress=progress,
            )
        )
        solution = Solution(problem, minima[-1].values)
        # The first solution may fail: the result says so. Later ones start at a solution; if they
        # fail, the weights left unknowns undetermined, and no result would be true.
        if len(minima) > 1 and not (converged(int(minima[-1].termination)) and solution.determined):
            names = undetermined_unknowns(problem, minima[-1].values)
            undetermined = ", ".join(names[:8])
            raise NotSolvedError(f"not solved after a change of weights: {undetermined}", names)
        return solution

    solution, removed, suspects, factors = minimise_again(problem, problem.data.start), [], [], {}
    # Iterations may have gone without a factor; statistics need one.
    problem = with_factor(problem)
    solution = Solution(problem, solution.values)
    unweighted = Result(problem, minima[-1])
    if not (unweighted.converged and (robust or snooping or estimate_components)):
        return unweighted
    if (snooping or estimate_components) and problem.plan.reduction not in FACTORS:
        raise InputError(
            "data snooping and variance components need redundancy numbers, and the problem is too "
            "large for them: use a part of it, or robust estimation"
        )
    unsettled: list[str] = []
    if robust:
        reweighted = reweight(problem, solution.values, minimise_again, robust)
        solution, suspects = reweighted.solution, reweighted.suspects(significance)
        unsettled += [] if reweighted.converged else ["robust weights"]
    if snooping:
        solution, removed = snoop(
            solution, minimise_again, test=snooping, significance=significance
        )
    if estimate_components:
        groups = kinds_as_groups(problem)
        solution, factors, changing = estimate(solution, groups, minimise_again)
        unsettled += [f"variance component of {name}" for name in changing]
    return Result(solution.problem, minima[-1], removed, suspects, factors, unsettled)


def kinds_as_groups(problem: Problem) -> list[VarianceGroup]:
    """Every kind of observations is a separate group."""
    sets: dict[str, list] = {}
    for observation_set in problem.observations:
        sets.setdefault(observation_set.kind.name, []).append((observation_set.name, np.s_[:]))
    return [VarianceGroup(name, parts) for name, parts in sets.items()]


def choose_eliminated(
    tables: Sequence[Table], observations: Sequence[ObservationSet], min_unknowns: int = 60
) -> str | None:
    """The table with the most unknowns of which no observation touches two rows, if elimination
    pays.

    Below `min_unknowns` the dense equations take microseconds, and a program without elimination
    compiles faster; nor does it pay to eliminate a quarter of the unknowns or less, which leaves
    nearly half of the operations of a factorisation, (3/4)³. Neither limit is critical."""
    touched_twice = {
        t
        for observation_set in observations
        for t in observation_set.kind.of
        if observation_set.kind.of.count(t) > 1
    }
    size = {t.name: int(t.free.sum()) for t in tables if t.name not in touched_twice}
    total = sum(int(t.free.sum()) for t in tables)
    largest = max(size, key=size.__getitem__, default=None)
    worth = largest is not None and total >= min_unknowns and size[largest] > total / 4
    return largest if worth else None


def _choose_motions(
    tables: Sequence[Table], datum: str | Mapping[str, Any], motions: Motions | None
) -> Motions | None:
    """The motions that may be open: those given, or the likely ones if a datum is chosen."""
    if isinstance(datum, str):
        one_of("datum", datum, DATUMS)
    if motions is not None or (isinstance(datum, str) and datum == "given"):
        return motions
    return likely_motions(tables)


def _hold_datum(
    tables: Sequence[Table],
    datum: str | Mapping[str, Any],
    gauge: Float[np.ndarray, "motions defect"],
) -> tuple[dict[str, Float[np.ndarray, "rows width"]], bool]:
    """The datum unknowns by table, and whether the datum is minimal."""
    all_unknowns = {t.name: np.ones((t.rows, t.space.width)) for t in tables}
    if isinstance(datum, str):
        if datum == "given":
            raise InputError(f"the datum is open in {gauge.shape[1]} parameters: give `datum`")
        return all_unknowns, datum == "minimal"
    datum_unknowns = {}
    for name, rows in datum.items():
        if name not in all_unknowns:
            raise InputError(f"datum: there is no table {name!r}; known: {', '.join(all_unknowns)}")
        table = next(t for t in tables if t.name == name)
        is_mask = np.asarray(rows).dtype == bool and np.shape(rows) == (table.rows,)
        rows = np.flatnonzero(rows) if is_mask else row_numbers("datum", rows)
        rows = table.rows_of(rows, "datum") if rows.dtype == object else rows
        if not len(rows):
            raise InputError(f"datum: no row of table {name!r} is given")
        for row in rows[(rows < 0) | (rows >= table.rows)][:1]:
            raise InputError(f"datum: there is no row {row} of table {name!r}: it has {table.rows}")
        datum_unknowns[name] = np.zeros(all_unknowns[name].shape)
        datum_unknowns[name][rows] = 1.0
    return datum_unknowns, False
