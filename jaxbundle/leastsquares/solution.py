"""Inspection of a solution: factor, cofactors and reliability, each computed on first access.

The padding that lets problems of similar size share compiled programs is removed here.
"""

import dataclasses
import functools
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxbundle.leastsquares.datum.by_table import directions_of_motions, move_into_datum
from jaxbundle.leastsquares.datum.conditions import (
    move_to_datum,
    of_groups,
    s_transform,
    s_transform_transposed,
)
from jaxbundle.leastsquares.equations.elimination import PIVOT, NormalFactor, factorise, solve
from jaxbundle.leastsquares.equations.linearise import differentiate
from jaxbundle.leastsquares.equations.normal import Normal, normal_equations
from jaxbundle.leastsquares.indexing.plan import Plan, Tangent
from jaxbundle.leastsquares.indexing.rows import (
    Data,
    Declared,
    Values,
    lay_out_data,
    prepare,
    residuals,
    restore_order,
)
from jaxbundle.leastsquares.iterations.retraction import changes_of_tables
from jaxbundle.leastsquares.iterations.solver import LeastSquares, Minimum, minimise_compiled
from jaxbundle.leastsquares.iterations.stopping import converged
from jaxbundle.leastsquares.problem import (
    Problem,
    is_large,
    make_solver,
    pad_data,
    pad_values,
    with_motions_at,
    without_filling,
)
from jaxbundle.leastsquares.quality.cofactors import (
    Cofactors,
    blocks_of_tables,
    cofactors,
    propagate,
)
from jaxbundle.leastsquares.quality.reliability import Reliability, reliability
from jaxbundle.leastsquares.sharding import distribute, find_minimum_of_shards, sharing_devices
from jaxbundle.system.programs import compile_once
from jaxbundle.types import AnyArray, not_none

# Placeholder of the plan in a factor returned by a compiled function.
PLAN_PLACEHOLDER = "the plan"

# Problems with at least this many observations are distributed over several devices; of smaller
# ones (5 ms an iteration) the devices would wait for each other longer than they compute.
MIN_SHARED_OBSERVATIONS = 10_000

# By the name of the set, rows in the given order.
Rows = dict[str, Float[np.ndarray, "n r"]]


def find_minimum(
    problem: Problem,
    start: Values | None = None,
    *,
    progress: Callable | None = None,
    **options: Any,
) -> Minimum[Values]:
    """Iterate from `start` (default: that of the problem) and move the solution to the datum;
    `options`: of the solver (`make_solver`). Held values and datum are those of the problem.

    `progress(step, cost, λ)` is called during the iterations of large problems, otherwise at their
    end: JAX compiles a program that calls the host in every process anew."""
    large = is_large(problem.observations, problem.planning)
    if large and progress is not None:
        options["progress"] = progress
    planned_start = pad_values(problem, problem.data.start)
    start = planned_start if start is None else pad_values(problem, start)
    minimise_from = _on_all_devices if _worth_sharing(problem, start) else _on_one_device
    minimise_from = minimise_from(problem, make_solver(problem, **options))
    if not large and progress is not None:
        minimise_from = _report_after(minimise_from, progress)
    undisplaced = minimum = minimise_from(start)
    # After ten returns the two do not agree: the last minimum is as good as the next.
    for _ in range(10):
        moved_problem = with_motions_at(problem, without_filling(problem, minimum.values))
        values = _move_to_datum(moved_problem, minimum.values, planned_start)
        # No weighted points: motions change no observation at all, and the minimum stays one.
        if moved_problem is problem or not bool(converged(minimum.termination)):
            break
        # Open combinations need not form a group (one open height of a point, say): the motion to
        # the datum may have left the minimum. 1e-12: of the digits that vᵀPv has after rounding;
        # added for exact data, whose vᵀPv is rounding alone: a change of 1e-12 is one of 1e-6 σ.
        cost_before, cost_after = (
            Solution(problem, without_filling(problem, v)).vtpv for v in (minimum.values, values)
        )
        if cost_after <= cost_before * (1 + 1e-12) + 1e-12:
            break
        minimum = minimise_from(values)
    else:
        values = minimum.values
    values = without_filling(problem, values)
    return dataclasses.replace(undisplaced, termination=minimum.termination, values=values)


def _report_after(minimise_from: Callable, progress: Callable) -> Callable:
    """A search that calls `progress(step, cost, λ)` for every evaluation when it has ended."""

    def minimise_and_report(start: Values) -> Minimum[Values]:
        minimum = minimise_from(start)
        history = jax.tree.map(np.asarray, minimum.history)
        for step in range(min(int(minimum.iterations), len(history.cost))):
            progress(step, history.cost[step], history.damping[step])
        return minimum

    return minimise_and_report


def _on_one_device(problem: Problem, solver: LeastSquares) -> Callable[[Values], Minimum[Values]]:
    data = pad_data(problem, problem.data)
    return lambda start: minimise_compiled(solver, data, start)


def _on_all_devices(problem: Problem, solver: LeastSquares) -> Callable[[Values], Minimum[Values]]:
    shards = distribute(problem)

    def minimise_from(start: Values) -> Minimum[Values]:
        minimum = find_minimum_of_shards(shards, solver, start)
        return dataclasses.replace(minimum, values=pad_values(problem, minimum.values))

    return minimise_from


def _worth_sharing(problem: Problem, start: Values) -> bool:
    """Whether there are several devices, and rows to distribute over them."""
    if len(sharing_devices()) == 1 or problem.plan.eliminated is None:
        return False
    if sum(o.number for o in problem.observations) < MIN_SHARED_OBSERVATIONS:
        return False
    # Devices that end at different steps would wait for each other forever.
    return all(np.isfinite(np.asarray(x)).all() for x in jax.tree.leaves(start))


def _move_to_datum(problem: Problem, values: Values, start: Values) -> Values:
    if problem.plan.datum is None:
        return values
    # By programs per table, compiled once for all problems; the rare deformation that needs Newton
    # steps compiles a program for its own.
    values_in_datum, is_reached = move_into_datum(problem.declared, problem.plan, values, start)
    if not is_reached:
        values_in_datum, _ = _move_by_newton(problem.declared, problem.plan, values, start)
    return values_in_datum


_move_by_newton = compile_once(move_to_datum)


def take_step(problem: Problem, values: Values) -> Values:
    """The unknowns after one undamped Gauss–Newton step, near a solution; NaN if singular."""
    data = pad_data(problem, problem.data)
    stepped = _step(
        problem.declared, problem.plan, pad_values(problem, values), data, problem.retraction
    )
    return without_filling(problem, stepped)


@compile_once
def _step(
    declared: Declared, plan: Plan, values: Values, data: Data, retraction: Callable
) -> Values:
    _, gradient, blocks = normal_equations(declared, plan, values, lay_out_data(plan, data))
    factor = factorise(Normal(plan, blocks))
    return retraction(plan, values, solve(factor, jax.tree.map(jnp.negative, gradient)))


class Solution:
    """Quantities for the statistics of a problem at its (adjusted) `values`."""

    def __init__(self, problem: Problem, values: Values):
        self._as_given, self.values = problem, values

    @functools.cached_property
    def problem(self) -> Problem:
        """The problem with its open motions at these values."""
        return with_motions_at(self._as_given, self.values)

    @functools.cached_property
    def _data(self) -> Data:
        return pad_data(self._as_given, self._as_given.data)

    @functools.cached_property
    def _values(self) -> Values:
        return pad_values(self._as_given, self.values)

    @functools.cached_property
    def residuals(self) -> Rows:
        """All residuals divided by their σ."""
        # Residuals do not depend on the datum, whose motions at these values need not be surveyed.
        declared, plan = self._as_given.declared, self._as_given.plan
        return self._rows(_residuals(declared, plan, self._values, self._data))

    @functools.cached_property
    def vtpv(self) -> float:
        """vᵀPv of all observations."""
        return float(sum((v**2).sum() for v in self.residuals.values()))

    @property
    def sigma0(self) -> float:
        """√(vᵀPv/redundancy); NaN without redundancy."""
        r = self.problem.counts.redundancy
        return float(np.sqrt(self.vtpv / r)) if r > 0 else float("nan")

    @functools.cached_property
    def factor(self) -> NormalFactor:
        """The normal equations, undamped, factorised."""
        return with_plan(_factor(*self.arguments), self.problem.plan)

    @property
    def determined(self) -> bool:
        """Whether no unknown is so weak that its σ is rounding noise."""
        # NaN pivots, of a matrix that is not positive definite, make the smallest one NaN, which is
        # not greater than anything.
        pivots = np.abs(np.asarray(self.factor.reduced.pivots))
        return bool(pivots.min(initial=1.0) ** 2 > PIVOT)

    @functools.cached_property
    def cofactors(self) -> Cofactors:
        """Blocks of the cofactor matrix."""
        return _cofactors(self.problem.declared, self._values, self.factor, self.moves)

    @functools.cached_property
    def moves(self) -> Tangent | None:
        """The generators of all tables along the motions; None if none is open."""
        declared, plan, values = self.arguments[:3]
        return None if plan.datum is None else directions_of_motions(declared, values)

    def cofactor(self, table: str) -> Float[np.ndarray, "rows width width"]:
        """The cofactor block of every row of a table; zero for held unknowns."""
        return self._blocks_of_tables[table]

    @functools.cached_property
    def _blocks_of_tables(self) -> dict[str, Float[np.ndarray, "rows width width"]]:
        """The cofactor blocks of all tables."""
        declared, plan, values = self.arguments[:3]
        blocks = _of_tables(declared, plan, self.cofactors.diagonal_blocks, values)
        return jax.tree.map(np.asarray, without_filling(self.problem, blocks))

    @functools.cached_property
    def reliability(self) -> Reliability:
        """Redundancy numbers and w of all observations."""
        by_part = reliability(*self.arguments, self.cofactors)
        return Reliability(**{f: self._rows(rows) for f, rows in vars(by_part).items()})

    def predicted_tests(self, data: Data) -> Rows:
        """nᵀu/√(1 + h) of all observations with the weights of `data` (`Reliability`; v/σ/√(1 + h)
        if uncorrelated): the normalised residuals of excluded observations, predicted from those in
        the adjustment and from the other residuals of their row."""
        arguments = (*self.arguments[:3], pad_data(self.problem, data))
        by_part = reliability(*arguments, self.cofactors)  # a program that is there already
        # v/σ of an observation that was not used has the variance 1 + h, not 1 − h: h from the
        # unknowns, 1 from itself.
        v, h = self._rows(by_part.standard), self._rows(by_part.hat)
        return {o: v[o] / np.sqrt(1 + h[o]) for o in v}

    @functools.cached_property
    def jacobian_eliminated(self) -> Rows:
        """The derivatives [n, r, w] of all observations with respect to the eliminated rows they
        touch, divided by their σ; without those that touch none."""
        return self._rows(_jacobian_eliminated(*self.arguments))

    def propagate(self, function: Callable[[Values], Array]) -> Float[np.ndarray, "n n"]:
        """The cofactors of any differentiable function (`Values` → [n]) of the unknowns, compiled
        once per function."""
        return self.propagate_rows(self.jacobian_of(function))

    def jacobian_of(self, function: Callable[[Values], Array]) -> dict[str, Array]:
        """The derivatives of a function of the unknowns with respect to the changes of tables,
        [n, rows, width] each."""
        zero_change = {t.name: np.zeros((t.rows, t.space.width)) for t in self.problem.tables}
        return _rows_of(function, self.problem.declared, self.values, zero_change)

    def propagate_rows(
        self, rows: Mapping[str, Float[AnyArray, "n rows width"]]
    ) -> Float[np.ndarray, "n n"]:
        """F·Q·Fᵀ of linear functions F of the changes of tables, [n, rows, width] each. Of the
        eliminated table they may be left out where they are zero, if the problem has no open
        motions and no row of the table is kept."""
        declared, plan, values = self.arguments[:3]
        size = self.problem.sizes
        wide = {
            t: np.pad(np.asarray(x), ((0, 0), (0, size["table", t] - x.shape[1]), (0, 0)))
            for t, x in rows.items()
        }
        return np.asarray(_propagate(declared, values, self.factor, wide, self.moves))

    def joint_cofactors(
        self, table: str, rows: Sequence[int]
    ) -> Float[np.ndarray, "n width n width"]:
        """The cofactors of some rows of a table among each other; zero for held unknowns."""
        declared, _, values = self.arguments[:3]
        blank = {
            t.name: np.zeros((self.problem.sizes["table", t.name], t.space.width))
            for t in self.problem.tables
        }
        arguments = (np.asarray(rows, int), blank, self.moves)
        return np.asarray(_joint_cofactors(table, declared, values, self.factor, *arguments))

    @property
    def arguments(self) -> tuple[Declared, Plan, Values, Data]:
        """What compiled functions of a solution take first; arrays in the sizes of the plan."""
        problem = self.problem
        return problem.declared, problem.plan, self._values, self._data

    def _rows(self, by_set: Mapping[str, AnyArray]) -> Rows:
        return {o.name: np.asarray(by_set[o.name])[: o.number] for o in self._as_given.observations}


@compile_once
def _residuals(
    declared: Declared, plan: Plan, values: Values, data: Data
) -> dict[str, Float[Array, "n r"]]:
    return restore_order(plan, residuals(declared, plan, values, lay_out_data(plan, data)))


@compile_once
def _factor(declared: Declared, plan: Plan, values: Values, data: Data) -> NormalFactor:
    *_, blocks = normal_equations(declared, plan, values, lay_out_data(plan, data))
    return without_plan(factorise(Normal(plan, blocks)))


def without_plan(factor: NormalFactor) -> NormalFactor:
    """A factor without its plan, which a compiled function would copy."""
    # Results of compiled functions are copies, also of arguments passed through.
    is_plan = lambda x: isinstance(x, Plan)
    return jax.tree.map(lambda x: PLAN_PLACEHOLDER if is_plan(x) else x, factor, is_leaf=is_plan)


def with_plan(factor: NormalFactor, plan: Plan) -> NormalFactor:
    """The factor with its plan restored."""
    return jax.tree.map(lambda x: plan if isinstance(x, str) else x, factor)


_cofactors = compile_once(cofactors)
_of_tables = compile_once(blocks_of_tables)


@compile_once
def _jacobian_eliminated(
    declared: Declared, plan: Plan, values: Values, data: Data
) -> dict[str, Float[Array, "n r w"]]:
    chunked, prepared, blocks = lay_out_data(plan, data), prepare(declared, values), []
    width = plan.groups[not_none(plan.eliminated)].width
    for number in range(len(plan.parts)):
        r, _, E = differentiate(declared, plan, number, prepared, chunked)
        blocks.append(jnp.zeros((*r.shape, width)) if E is None else E)
    return restore_order(plan, blocks)


@compile_once
def _rows_of(
    function: Callable[[Values], Array], declared: Declared, values: Values, zero_change: Values
) -> dict[str, Float[Array, "n rows width"]]:
    """The derivatives of a function of the tables with respect to their changes, [n, rows, width]
    each."""

    def of_change(change: Values) -> Float[Array, " n"]:
        changed = dict(values)
        for name, d in change.items():
            changed[name] = jax.vmap(declared.spaces[name].retract)(values[name], d)
        return jnp.atleast_1d(function(changed))

    return jax.jacrev(of_change)(zero_change)


@compile_once
def _joint_cofactors(
    table: str,
    declared: Declared,
    values: Values,
    factor: NormalFactor,
    rows: Int[Array, " n"],
    blank: Values,
    moves: Tangent | None,
) -> Float[Array, "n width n width"]:
    """Columns of Q, of which only the rows wanted are kept."""
    plan, width = factor.plan, blank[table].shape[1]

    def column(row: Int[Array, ""], axis: Int[Array, ""]) -> Float[Array, "n width"]:
        unit_row = of_groups(plan, blank | {table: blank[table].at[row, axis].set(1.0)})
        change = solve(factor, s_transform_transposed(declared, plan, values, unit_row, moves))
        change = s_transform(declared, plan, values, change, moves)
        return (blank | changes_of_tables(plan, values, change))[table][rows]

    # Sixteen columns at once: products of matrices in the reduced system, of 38 MB for 100 000
    # points. 50 of 30 000 points take 110 MB; all columns together took 2.4 GB, in the same time.
    places = jnp.repeat(rows, width), jnp.tile(jnp.arange(width), len(rows))
    columns = jax.lax.map(lambda place: column(*place), places, batch_size=16)
    return columns.reshape(len(rows), width, len(rows), width)


@compile_once
def _propagate(
    declared: Declared, values: Values, factor: NormalFactor, rows: Values, moves: Tangent | None
) -> Float[Array, "n n"]:
    plan = factor.plan
    rows = jax.vmap(lambda r: of_groups(plan, r))(rows)
    return propagate(declared, values, factor, rows, moves)
