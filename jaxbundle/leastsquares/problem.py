"""A problem made ready for the solver: plan, numbers, and how many rows and unknowns it has."""

import dataclasses
from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxbundle.errors import InputError
from jaxbundle.leastsquares.datum import find_open_motions, make_datum
from jaxbundle.leastsquares.declarations import Motions, Observations, Table
from jaxbundle.leastsquares.indices import common, finish, rounded
from jaxbundle.leastsquares.plan import Plan, make_plan
from jaxbundle.leastsquares.reduction import FACTORS, REDUCTIONS
from jaxbundle.leastsquares.retraction import retract
from jaxbundle.leastsquares.rows import Data, Declared
from jaxbundle.leastsquares.solver import LeastSquares, minimise
from jaxbundle.leastsquares.stopping import Tolerance

LARGE = 200_000
"""Problems of more observations are compiled for their own sizes."""


@dataclasses.dataclass(frozen=True)
class Problem:
    """What is solved: declarations, plan and numbers. `rows`: the observations' residuals."""

    tables: tuple[Table, ...]
    observations: tuple[Observations, ...]
    declared: Declared
    plan: Plan
    data: Data
    sizes: dict
    counts: "Counts"


@dataclasses.dataclass(frozen=True)
class Counts:
    """Rows that carry weight, and free unknowns."""

    observations: int
    unknowns: int
    datum: int = 0

    @property
    def redundancy(self) -> int:
        return self.observations + self.datum - self.unknowns


def make_problem(
    tables: Sequence[Table], observations: Sequence[Observations], eliminate: str | None = None,
    *, motions: Motions | None = None, datum_weight: dict[str, np.ndarray] | None = None,
    minimal: bool = False, reduction: str | None = None,
) -> Problem:  # fmt: skip
    """Plan and arrays of declared tables and observations.

    `motions`: those that may be open; `datum_weight`: by table, the unknowns that hold the datum
    then (`minimal`: as few of them as needed). `reduction`: how the reduced system is solved,
    "dense", "banded" or "iterative"; chosen by its size and fill if not given."""
    if reduction not in (None, *REDUCTIONS):
        raise InputError(f"reduction {reduction!r}: {', '.join(REDUCTIONS)}")
    tables, observations = tuple(tables), tuple(observations)
    check(tables, observations)
    spaces = tuple((t.name, t.space) for t in tables)
    declared = Declared(tuple(o.kind for o in observations), spaces, motions)
    ways = REDUCTIONS if reduction is None else (reduction,)
    plan, sizes = _make_plan(tables, observations, eliminate, ways)
    data = make_data(declared, tables, observations)
    counts = Counts(
        sum(int((np.asarray(_diagonal(w)) > 0).sum()) for w in data.weight),
        sum(int((t.free > 0).sum()) for t in tables),
    )
    problem = Problem(tables, observations, declared, plan, data, sizes, counts)
    return problem if motions is None else _with_datum(problem, datum_weight, minimal)


def _make_plan(tables, observations, eliminate, ways):
    """The plan on the device, and the sizes of its lists."""
    host, sizes, _ = make_plan(tables, observations, eliminate, ways=ways)
    number = sum(o.number for o in observations)
    sizes = common([sizes], lambda key, n: n if number > LARGE else rounded(n))
    return jax.device_put(finish(host, sizes)), sizes


def with_factor(problem: Problem) -> Problem:
    """The problem with a reduced system that can be factorised, as statistics need it; the same
    where no factor fits into memory."""
    if problem.plan.reduction in FACTORS:
        return problem
    given = problem.tables, problem.observations, problem.plan.eliminated
    plan, sizes = _make_plan(*given, FACTORS)
    if plan.reduction not in FACTORS:
        return problem
    plan = dataclasses.replace(plan, datum=problem.plan.datum)
    return dataclasses.replace(problem, plan=plan, sizes=sizes)


def _with_datum(problem: Problem, weight, minimal: bool) -> Problem:
    data = pad_data(problem, problem.data)
    real = {t.name: np.arange(problem.sizes["table", t.name]) < t.rows for t in problem.tables}
    gauge = find_open_motions(problem.declared, problem.plan, data, real)
    if not gauge.shape[1]:
        return problem
    if weight is None:
        raise InputError(f"the datum is open in {gauge.shape[1]} parameters: say what holds it")
    fill = lambda t, w: np.concatenate(
        [w, np.zeros((problem.sizes["table", t] - len(w), w.shape[1]))]
    )
    weight = {t: fill(t, np.asarray(w, float)) for t, w in weight.items()}
    datum = make_datum(problem.declared, problem.plan, data, gauge, weight, minimal, real)
    datum = jax.device_put(datum)
    plan = dataclasses.replace(problem.plan, datum=datum)
    counts = dataclasses.replace(problem.counts, datum=gauge.shape[1])
    return dataclasses.replace(problem, plan=plan, counts=counts)


def check(tables, observations) -> None:
    """Refuse tables of one name, observations of unknown tables, rows that do not exist."""
    known = {}
    for table in tables:
        if table.name in known:
            raise InputError(f"two tables are called {table.name!r}")
        known[table.name] = table
    for given in observations:
        for name, rows in zip(given.kind.of, given.rows):
            if name not in known:
                raise InputError(
                    f"{given.kind.name}: there is no table {name!r}; known: {', '.join(known)}"
                )
            bad = (rows < 0) | (rows >= known[name].rows)
            if bad.any():
                row = int(np.argmax(bad))
                raise InputError(
                    f"{given.kind.name}: observation {row + 1} touches row {int(rows[row])} of "
                    f"table {name!r}, which has rows 0 to {known[name].rows - 1}"
                )


def make_data(declared: Declared, tables, observations) -> Data:
    """The numbers of a problem as arrays."""
    start = {t.name: jax.tree.map(lambda x: np.asarray(x, float), t.value) for t in tables}
    weights = [o.weight(_number_of_residuals(declared, start, o)) for o in observations]
    return jax.device_put(Data(start, tuple(o.measured for o in observations), tuple(weights)))


def _number_of_residuals(declared: Declared, start, given: Observations) -> int:
    """How many residuals an observation of a kind has, from the shapes alone."""
    from jaxbundle.leastsquares.rows import _evaluate, scalars

    one = lambda tree: jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape[1:], float), tree)

    def evaluate(values, measured):
        blocks = []
        for name in given.kind.of:
            space = declared.spaces[name]
            blocks.append(space.moved(space.prepare(values[name]), ()))
        as_scalars = scalars(jax.tree.map(lambda x: x[None], measured))
        as_scalars = jax.tree.map(lambda x: x[0], as_scalars)
        return _evaluate(given.kind, blocks, as_scalars)

    return len(jax.eval_shape(evaluate, one(start), one(given.measured)))


def _diagonal(weight):
    return weight if weight.ndim == 2 else np.diagonal(weight, axis1=1, axis2=2)


def pad_data(problem: Problem, data: Data) -> Data:
    """The numbers filled to the sizes of the plan: rows repeat the last one, weights are 0. Under a
    transformation of JAX as well."""
    traced = any(isinstance(x, jax.core.Tracer) for x in jax.tree.leaves(data))
    np_, size = jnp if traced else np, problem.sizes

    def filled(x, key, mode):
        x = np_.asarray(x)
        return np_.pad(x, [(0, size[key] - len(x)), *[(0, 0)] * (x.ndim - 1)], mode)

    of = lambda tree, key, mode="constant": jax.tree.map(lambda x: filled(x, key, mode), tree)
    return jax.device_put(Data(
        {t: of(rows, ("table", t), "edge") for t, rows in data.start.items()},
        tuple(of(x, ("observations", o)) for o, x in enumerate(data.measured)),
        tuple(of(x, ("observations", o)) for o, x in enumerate(data.weight)),
    ))  # fmt: skip


def given_data(problem: Problem, data: Data | None) -> Data:
    """The numbers in the sizes of the plan: those of the problem, or others of the same shapes.

    **Raises:** `InputError` where the shapes are others."""
    known, data = problem.data, problem.data if data is None else data
    shapes = lambda data: (jax.tree.structure(data), [jnp.shape(x) for x in jax.tree.leaves(data)])
    if shapes(data) != shapes(known):
        raise InputError("data must be a Data with arrays of the shapes of problem.data")
    return pad_data(problem, data)


def unpad(problem: Problem, tables):
    """The rows of the tables without those filled in."""
    cut = lambda tree, rows: jax.tree.map(lambda x: x[:rows], tree)
    return {t.name: cut(tables[t.name], t.rows) for t in problem.tables}


def make_solver(
    problem: Problem, *, atol=1e-5, rtol=0.0, retraction=None, **options
) -> LeastSquares:
    """The solver of a problem; `options` are those of `LeastSquares`."""
    declared = problem.declared
    squares = sum(
        float(((np.asarray(_diagonal(w)) * np.asarray(m).reshape(w.shape[:2])) ** 2).sum())
        for w, m in zip(problem.data.weight, problem.data.measured)
        if hasattr(m, "shape") and m.size == w.shape[0] * w.shape[1]
    )
    to_device = lambda x: jax.device_put(np.float64(x))
    tolerance = Tolerance(to_device(problem.counts.redundancy), to_device(squares), atol, rtol)
    return LeastSquares(
        declared, problem.plan, tolerance, retraction or Retraction(declared), **options
    )


@dataclasses.dataclass(frozen=True)
class Retraction:
    declared: Any

    def __call__(self, plan, values, change):
        return retract(self.declared, plan, values, change)


find_minimum = eqx.filter_jit(minimise)
