"""A problem prepared for the solver: plan, numbers, and counts of rows and unknowns."""

import dataclasses
import itertools
import math
from collections.abc import Callable, Hashable, Mapping, Sequence
from functools import partial
from typing import Any, Literal, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Bool, Float, PyTree

from jaxbundle.arguments import one_of, show
from jaxbundle.choices import REDUCTIONS
from jaxbundle.errors import InputError
from jaxbundle.float64 import require_x64
from jaxbundle.leastsquares.datum.defect import (
    Survey,
    find_open_motions,
    make_datum,
    survey_motions,
)
from jaxbundle.leastsquares.declarations import Kind, Motions, ObservationSet, Table
from jaxbundle.leastsquares.indexing.indices import Sizes, common, finish, round_up
from jaxbundle.leastsquares.indexing.plan import Plan, Tangent
from jaxbundle.leastsquares.indexing.planner import make_plan
from jaxbundle.leastsquares.indexing.reduction import FACTORS
from jaxbundle.leastsquares.indexing.rows import (
    Data,
    Declared,
    Values,
    evaluate,
    scalars,
)
from jaxbundle.leastsquares.indexing.settings import PLANNING, PlanningSettings
from jaxbundle.leastsquares.iterations.retraction import retract
from jaxbundle.leastsquares.iterations.solver import LeastSquares
from jaxbundle.leastsquares.iterations.stopping import Tolerance
from jaxbundle.leastsquares.spaces import Space
from jaxbundle.leastsquares.whitening import diagonal, has_weight, inverse_sigma
from jaxbundle.system.memory import return_freed_memory
from jaxbundle.types import AnyArray, Scalar, not_none


@dataclasses.dataclass(frozen=True)
class Problem:
    """A problem: declarations, plan and numbers. `sizes`: of the lists of the plan; `choices`:
    those of its planning (`planner.make_plan`); `information`: of its motions, GᵀJᵀPJG of all
    observations that one changes, at the start values (None: some are open, or would move what is
    held)."""

    tables: tuple[Table, ...]
    observations: tuple[ObservationSet, ...]
    declared: Declared
    plan: Plan
    data: Data
    sizes: dict
    choices: dict
    counts: "SystemCounts"
    retraction: Callable
    information: Float[np.ndarray, "motions motions"] | None

    @property
    def planning(self) -> PlanningSettings:
        """The settings of its planning."""
        return self.choices["settings",]

    def table(self, name: str) -> Table:
        """The table of this name."""
        return next(t for t in self.tables if t.name == name)

    def observations_of(self, name: str) -> ObservationSet:
        """The set of observations of this name.

        **Raises:** `KeyError`."""
        sets = {o.name: o for o in self.observations}
        if name not in sets:
            raise KeyError(f"there are no observations {name!r}; known: {', '.join(sets)}")
        return sets[name]

    def weights(self, name: str) -> Float[np.ndarray, "n r"]:
        """1/σ of the residuals of a set of observations, the root of p; 0 without weight."""
        return inverse_sigma(np.asarray(self.data.weight[name]))

    @property
    def reduced_size(self) -> int:
        """Unknowns of the reduced system, including held ones."""
        e = self.plan.eliminated
        # With held columns: the matrix has them, with ones on its diagonal.
        size = sum(t.rows * t.space.width for t in self.tables if t.free.any() and t.name != e)
        return size if e is None else size + self.kept_rows.sum() * self.table(e).space.width

    @property
    def kept_rows(self) -> Bool[np.ndarray, " rows"]:
        """Rows of the eliminated table that are kept."""
        if self.plan.eliminated is None:
            return np.zeros(0, bool)
        is_kept = np.zeros(self.table(self.plan.eliminated).rows, bool)
        for name, group in self.plan.groups.items():
            for m in group.members:
                if m.table == self.plan.eliminated != name:
                    rows = np.asarray(m.rows)
                    is_kept[rows[rows < len(is_kept)]] = True
        return is_kept


# A problem, or one that knows more, such as the network it is of.
AnyProblem = TypeVar("AnyProblem", bound=Problem)


@dataclasses.dataclass(frozen=True)
class SystemCounts:
    """Rows with weight, and free unknowns."""

    observations: int
    unknowns: int
    datum: int = 0

    @property
    def redundancy(self) -> int:
        return self.observations + self.datum - self.unknowns


def make_problem(
    tables: Sequence[Table],
    observations: Sequence[ObservationSet],
    eliminate: str | None = None,
    *,
    motions: Motions | None = None,
    datum: Callable | None = None,
    retraction: Callable[[Declared], Callable] | None = None,
    reduction: str | None = None,
    planning: PlanningSettings = PLANNING,
) -> Problem:
    """Plan and arrays of declared tables and observations.

    `motions`: those that may be open. If some are, `datum(gauge)` is called with the combinations
    [motions, defect] that change no observation and returns the datum unknowns, [rows, width] by
    table, and whether the datum is minimal. `retraction(declared)` gives the function `(plan,
    values, change)` that applies a change, by default `Retraction`. `reduction`: solver of the
    reduced system, "dense", "banded" or "iterative"; by default chosen by size and fill.
    `planning`: sizes at which the plan changes its form."""
    require_x64()
    one_of("reduction", reduction, REDUCTIONS, allow_none=True)
    tables = tuple(tables)
    observations = tuple(observation_set.resolve_labels(tables) for observation_set in observations)
    observations = distinct_names(observations)
    check(tables, observations)
    spaces = tuple((t.name, t.space) for t in tables)
    declared = Declared(tuple((o.name, o.kind) for o in observations), spaces, motions)
    solvers = REDUCTIONS if reduction is None else (reduction,)
    # The plan depends on which rows meet and what is free, not on values.
    planned = _make_plan(tables, observations, eliminate, solvers, planning)
    data = make_data(tables, observations)
    problem = Problem(
        tables,
        observations,
        declared,
        planned[0],
        data,
        *planned[1:],
        count(tables, data),
        (retraction or Retraction)(declared),
        None,
    )
    problem = problem if motions is None else _with_datum(problem, datum)
    # Sorting more observations than this leaves megabytes in the allocator.
    if sum(o.number for o in observations) > 10_000:
        return_freed_memory()
    return problem


def _make_plan(
    tables: Sequence[Table],
    observations: Sequence[ObservationSet],
    eliminate: str | None,
    solvers: Sequence[str],
    settings: PlanningSettings,
) -> tuple[Plan, Sizes, dict]:
    """The plan on the device, the sizes of its lists, and the choices made."""
    host, sizes, choices = make_plan(
        tables, observations, eliminate, solvers=solvers, settings=settings
    )
    sizes = common([sizes], choose_rounding(observations, settings))
    return jax.device_put(finish(host, sizes)), sizes, choices


def choose_rounding(
    observations: Sequence[ObservationSet], settings: PlanningSettings
) -> Callable[[Hashable, int], int]:
    """The rounding of plan sizes for this number of observations."""
    large = is_large(observations, settings)
    return lambda _key, n: n if large else round_up(n)


def is_large(observations: Sequence[ObservationSet], settings: PlanningSettings) -> bool:
    """Whether a problem is worth a program of its own."""
    return sum(o.number for o in observations) > settings.exact_sizes_from


def with_factor(problem: AnyProblem) -> AnyProblem:
    """The problem with a reduced system that can be factorised for statistics; unchanged if no
    factor fits into memory."""
    if problem.plan.reduction in FACTORS:
        return problem
    declared = problem.tables, problem.observations, problem.plan.eliminated
    plan, sizes, choices = _make_plan(*declared, FACTORS, problem.planning)
    if plan.reduction not in FACTORS:
        return problem
    plan = dataclasses.replace(plan, datum=problem.plan.datum)
    return dataclasses.replace(problem, plan=plan, sizes=sizes, choices=choices)


def _with_datum(problem: Problem, choose: Callable | None) -> Problem:
    data = pad_data(problem, problem.data)
    real = {t.name: np.arange(problem.sizes["table", t.name]) < t.rows for t in problem.tables}
    survey = survey_motions(problem.declared, problem.plan, data, real)
    gauge = find_open_motions(survey)
    if not gauge.shape[1]:
        return dataclasses.replace(problem, information=_information(problem, survey))
    if choose is None:
        raise InputError(f"the datum is open in {gauge.shape[1]} parameters: give `datum`")
    weight, minimal = choose(gauge)
    weight = {
        t: _append_unused(np.asarray(w, float), problem.sizes["table", t], "constant")
        for t, w in weight.items()
    }
    datum = make_datum(problem.plan, survey, gauge, weight, minimal, real)
    plan = dataclasses.replace(problem.plan, datum=jax.device_put(datum))
    counts = dataclasses.replace(problem.counts, datum=gauge.shape[1])
    return dataclasses.replace(problem, plan=plan, counts=counts)


def _information(problem: Problem, survey: Survey) -> Float[np.ndarray, "motions motions"] | None:
    moved = [name for name, _ in not_none(problem.declared.motions).actions]
    if any((t.free == 0).any() for t in problem.tables if t.name in moved):
        return None
    products = [np.asarray(product) for product in survey.products]
    return sum((x.T @ x for x in products), np.zeros((survey.squares.shape[0],) * 2))


def with_motions_at(problem: AnyProblem, values: Values) -> AnyProblem:
    """The problem with its open motions at these values: those about a weighted point follow the
    point."""
    datum, kinds = problem.plan.datum, problem.declared.kinds.values()
    if datum is None or all(kind.invariant for kind in kinds):
        return problem
    data = pad_data(problem, dataclasses.replace(problem.data, start=values))
    real = {t.name: np.arange(problem.sizes["table", t.name]) < t.rows for t in problem.tables}
    # Without its datum, which a survey does not use, the plan has the program of `make_problem`.
    floating = dataclasses.replace(problem.plan, datum=None)
    gauge = find_open_motions(survey_motions(problem.declared, floating, data, real))
    # The defect is that of the start values, whatever it is by chance elsewhere.
    if gauge.shape != datum.gauge.shape:
        return problem
    datum = dataclasses.replace(datum, gauge=jax.device_put(gauge))
    return dataclasses.replace(problem, plan=dataclasses.replace(problem.plan, datum=datum))


def hold(
    problem: AnyProblem,
    table: str,
    rows: int | Sequence[int],
    columns: slice | Sequence[int] = slice(None),
) -> AnyProblem:
    """The problem with some unknowns held at their start values, removed from the datum
    unknowns."""
    held_table = problem.table(table)
    free = held_table.free.copy()
    free[np.ix_(np.atleast_1d(rows), np.arange(held_table.space.width)[columns])] = 0.0
    return with_free(problem, table, free)


def with_free(problem: AnyProblem, table: str, free: Float[np.ndarray, "rows width"]) -> AnyProblem:
    """The problem with these unknowns of a table free (if free when planned) and the others held at
    their start values and removed from the datum unknowns."""
    tables = tuple(
        dataclasses.replace(t, free=free) if t.name == table else t for t in problem.tables
    )
    wide = _append_unused(free, problem.sizes["table", table], "constant")
    plan, groups = problem.plan, dict(problem.plan.groups)
    for name, group in groups.items():
        for m in group.members:
            if m.table == table:
                part = wide if m.rows is None else wide[np.asarray(m.rows)]
                is_free = np.array(group.free)
                # `all_free` off: the mask takes part from now on, in another program.
                is_free[:, m.start : m.start + m.width] = part[: len(is_free)]
                group = dataclasses.replace(group, free=jax.device_put(is_free), all_free=False)
        groups[name] = group
    if plan.datum is not None and table in plan.datum.weight:
        weight = plan.datum.weight | {table: plan.datum.weight[table] * wide}
        plan = dataclasses.replace(plan, datum=dataclasses.replace(plan.datum, weight=weight))
    plan = dataclasses.replace(plan, groups=groups)
    counts = dataclasses.replace(count(tables, problem.data), datum=problem.counts.datum)
    return dataclasses.replace(problem, tables=tables, plan=plan, counts=counts)


def with_data(problem: AnyProblem, data: Data) -> AnyProblem:
    """The problem with other data of the same shapes."""
    counts = dataclasses.replace(count(problem.tables, data), datum=problem.counts.datum)
    return dataclasses.replace(problem, data=data, counts=counts)


def count(tables: Sequence[Table], data: Data) -> SystemCounts:
    """Rows with weight, and free unknowns."""
    return SystemCounts(
        sum(int(has_weight(np.asarray(w)).sum()) for w in data.weight.values()),
        sum(int((t.free > 0).sum()) for t in tables),
    )


def check(tables: Sequence[Table], observations: Sequence[ObservationSet]) -> None:
    """Refuse duplicate table names, and rows that do not exist; `resolve_labels` has refused
    unknown tables."""
    table_of = {}
    for table in tables:
        if table.name in table_of:
            raise InputError(f"two tables are called {table.name!r}")
        table_of[table.name] = table
    for observation_set in observations:
        for name, rows in zip(observation_set.kind.of, observation_set.rows):
            bad = (rows < 0) | (rows >= table_of[name].rows)
            if bad.any():
                row = int(np.argmax(bad))
                raise InputError(
                    f"{observation_set.kind.name}: observation {row + 1} touches row "
                    f"{int(rows[row])} of table {name!r}, which has rows 0 to "
                    f"{table_of[name].rows - 1}"
                )


def distinct_names(observations: Sequence[ObservationSet]) -> tuple[ObservationSet, ...]:
    """Sets of observations under names that differ: a second "distance" is "distance 2"."""
    taken_names: set[str] = set()
    renamed = []
    for observation_set in observations:
        names = itertools.chain(
            [observation_set.name], (f"{observation_set.name} {k}" for k in itertools.count(2))
        )
        name = next(n for n in names if n not in taken_names)
        taken_names.add(name)
        renamed.append(dataclasses.replace(observation_set, name=name))
    return tuple(renamed)


def check_numbers(
    tables: Sequence[Table],
    observations: Sequence[ObservationSet],
    weights: Mapping[str, Float[np.ndarray, "n ..."]],
) -> None:
    """Refuse start values, and measured values with weight, that are not finite."""
    for table in tables:
        for rows in jax.tree.leaves(table.value):
            bad = ~np.isfinite(rows)
            if bad.any():
                row = table.label(int(np.argwhere(bad)[0][0]))
                raise InputError(f"{table.title} {row}: a start value is not a finite number")
    for observation_set in observations:
        weight = weights[observation_set.name]
        for rows in jax.tree.leaves(observation_set.measured):
            bad = ~np.isfinite(rows).reshape(observation_set.number, math.prod(np.shape(rows)[1:]))
            counts = has_weight(weight)
            # Measured values without weight may be anything: excluded observations keep their rows.
            bad &= counts if counts.shape == bad.shape else counts.any(1, keepdims=True)
            if bad.any():
                row = int(np.argwhere(bad)[0][0])
                raise InputError(
                    f"observation {row + 1}, {observation_set.label(tables, row)}: a measured "
                    "value is not a finite number; an infinite sigma leaves an observation out"
                )


def make_data(tables: Sequence[Table], observations: Sequence[ObservationSet]) -> Data:
    """The data of a problem as arrays."""
    start = {t.name: jax.tree.map(lambda x: np.asarray(x, float), t.value) for t in tables}
    weights = weights_of(tables, observations)
    check_numbers(tables, observations, weights)
    measured = {o.name: o.measured for o in observations}
    return Data(*jax.device_put((start, measured, weights)))


def weights_of(
    tables: Sequence[Table], observations: Sequence[ObservationSet]
) -> dict[str, Float[np.ndarray, "n ..."]]:
    """The weights of sets of observations by name; the number of residuals of a kind is found from
    the shapes."""
    table_of = {t.name: t for t in tables}
    one_row = lambda tree: jax.tree.map(
        lambda x: jax.ShapeDtypeStruct(np.shape(x)[1:], float), tree
    )

    def number(observation_set: ObservationSet) -> int:
        touched_tables = [table_of[name] for name in observation_set.kind.of]
        values, spaces = [t.value for t in touched_tables], tuple(t.space for t in touched_tables)
        kind = observation_set.kind
        expected = (
            f"{kind.name}: its residual cannot be evaluated; expected a function of a row of "
            f"{', '.join(kind.of)} and the measured value that returns a number, or a tuple or "
            "array of them"
        )
        try:
            residuals = _evaluate.eval_shape(
                kind, spaces, one_row(values), one_row(observation_set.measured)
            )
        except (TypeError, AttributeError, ValueError, IndexError) as error:
            # The function of a user; its own message says where, this one which it is.
            why = " ".join(str(error).split())
            raise InputError(f"{expected}; it raised {type(error).__name__}: {why:.160}") from error
        if not all(getattr(x, "shape", None) == () for x in residuals):
            raise InputError(f"{expected}; it returned {show(residuals)}")
        return len(residuals)

    return {
        observation_set.name: observation_set.weight(number(observation_set))
        for observation_set in observations
    }


@partial(jax.jit, static_argnums=(0, 1))
def _evaluate(
    kind: Kind, spaces: tuple[Space, ...], values: Sequence[PyTree], measured: PyTree
) -> tuple[Scalar, ...]:
    """The residuals of one observation."""
    blocks = [space.move(space.prepare(v), ()) for space, v in zip(spaces, values)]
    # Only shapes are computed (`eval_shape`): how many residuals a kind has is nowhere declared.
    single = scalars(jax.tree.map(lambda x: x[None], measured))
    return evaluate(kind, blocks, jax.tree.map(lambda x: x[0], single))


def pad_data(problem: Problem, data: Data) -> Data:
    """The data padded to the sizes of the plan, on the device."""
    filled = fill_data(problem, data)
    if any(isinstance(x, Tracer) for x in jax.tree.leaves(filled)):
        # One by one: JAX cannot batch several together whose batch axes differ.
        return jax.tree.map(jax.device_put, filled)
    return jax.device_put(filled)


def fill_data(problem: Problem, data: Data) -> Data:
    """The data padded to the sizes of the plan, with weights 0."""
    fill = lambda o: lambda x: _append_unused(x, problem.sizes["observations", o], "constant")
    return Data(
        pad_values(problem, data.start),
        {o: jax.tree.map(fill(o), m) for o, m in data.measured.items()},
        {o: fill(o)(w) for o, w in data.weight.items()},
    )


def pad_values(problem: Problem, values: Values) -> Values:
    """The tables padded to the sizes of the plan by repeating the last row."""
    fill = lambda t: lambda x: _append_unused(x, problem.sizes["table", t], "edge")
    return {t: jax.tree.map(fill(t), rows) for t, rows in values.items()}


def without_filling(problem: Problem, values: Values) -> Values:
    """The tables without padding."""
    traced = any(isinstance(x, Tracer) for x in jax.tree.leaves(values))
    # On the host, where nothing is compiled for it.
    first_rows = lambda x, n: x[:n] if traced else jax.device_put(np.asarray(x)[:n])
    return {
        t.name: jax.tree.map(lambda x, n=t.rows: first_rows(x, n), values[t.name])
        for t in problem.tables
    }


def _append_unused(x: AnyArray, n: int, mode: Literal["constant", "edge"]) -> Any:
    """At least one row more, so that there is an unused one."""
    x = x if isinstance(x, Tracer) else np.asarray(x)
    room = [(0, n - len(x)), *[(0, 0)] * (x.ndim - 1)]
    return jnp.pad(x, room, mode) if isinstance(x, Tracer) else np.pad(x, room, mode)


def complete_data(problem: Problem, data: Data | None) -> Data:
    """The data in the sizes of the plan: those of the problem, or others of the same shapes.

    **Raises:** `InputError` if the shapes differ."""
    planned, data = problem.data, problem.data if data is None else data
    if not isinstance(data, Data):
        raise InputError(f"data must be a Data, such as problem.data, but is {show(data)}")
    shapes, planned_shapes = _shapes_by_name(data), _shapes_by_name(planned)
    if shapes != planned_shapes:
        names = dict.fromkeys([*planned_shapes, *shapes])
        name = next(n for n in names if shapes.get(n) != planned_shapes.get(n))
        raise InputError(
            f"data{name}: expected {planned_shapes.get(name, 'nothing')}, as in problem.data, got "
            f"{shapes.get(name, 'nothing')}"
        )
    # Numbers of single precision are taken as they are, and adjusted in double precision.
    double = lambda x: x.astype(float) if isinstance(x, Tracer) else np.asarray(x, float)
    return pad_data(problem, jax.tree.map(double, data))


def _shapes_by_name(data: Data) -> dict[str, tuple[int, ...]]:
    """The shapes of all arrays, by names such as ".measured['image']"."""
    leaves = jax.tree_util.tree_leaves_with_path(data)
    return {jax.tree_util.keystr(path): jnp.shape(x) for path, x in leaves}


def make_solver(
    problem: Problem,
    *,
    atol: float = 1e-5,
    rtol: float = 0.0,
    max_steps: int = 100,
    largest_max_steps: int = 0,
    **options: Any,
) -> LeastSquares:
    """The solver of a problem; `options` are those of `LeastSquares`. Searches of one
    `largest_max_steps` share its program, whatever their `max_steps`."""
    data = problem.data
    squares = sum(_measured_squares(w, data.measured[o]) for o, w in data.weight.items())
    to_device = lambda x: jax.device_put(np.float64(x))
    tolerance = Tolerance(*map(to_device, (problem.counts.redundancy, squares, atol, rtol)))
    # The rows of the history are compiled in: a size for the 100 steps of an adjustment, one for
    # the 2000 of a reconstruction with an unknown camera, and the most that are recorded, since
    # three arrays of them are kept on every device.
    limit = max(max_steps, largest_max_steps)
    rows = next((rows for rows in (128, 2048) if limit < rows), 10_000)
    return LeastSquares(
        problem.declared,
        problem.plan,
        tolerance,
        problem.retraction,
        rows=rows,
        max_steps=jax.device_put(np.int64(max_steps)),
        **options,
    )


def _measured_squares(
    weight: Float[AnyArray, "n ..."], measured: PyTree[Float[AnyArray, "n ..."]]
) -> float:
    """The sum of the squares of measured values divided by their σ, which gives the rounding of the
    residuals. Of several arrays the largest of those with one number for each residual counts; if
    there is none, the largest number of each observation."""
    # Of correlated observations 1/σ given the others of its row: an estimate of rounding needs no
    # more.
    w = diagonal(np.asarray(weight))
    size = lambda m: (len(w), math.prod(np.shape(m)[1:]))
    arrays = [np.asarray(m).reshape(size(m)) for m in jax.tree.leaves(measured)]
    fitting = [m for m in arrays if m.shape == w.shape]
    if not fitting:
        fitting = [np.abs(m).max(1, keepdims=True) for m in arrays if m.size]
    return max((float((np.where(w > 0, w * m, 0.0) ** 2).sum()) for m in fitting), default=0.0)


@dataclasses.dataclass(frozen=True)
class Retraction:
    """The retraction of every table by its space."""

    declared: Declared

    def __call__(self, plan: Plan, values: Values, change: Tangent) -> Values:
        return retract(self.declared, plan, values, change)
