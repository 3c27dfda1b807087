"""One minimum on several devices: eliminated rows distributed, with the observations of them.

Every device eliminates its own rows. What is kept is on all of them: the sums over it, the reduced
matrix and its right-hand side are added up over the devices (`normal.total`), and every device
solves the reduced system and moves its rows. What touches no eliminated row belongs to the first
device. The same program runs on the cores of a processor (`jax_num_cpu_devices`), on several GPUs,
and in several processes after `jax.distributed.initialize`.
"""

import dataclasses

import equinox as eqx
import jax
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from jaxtyping import Int

from jaxbundle.errors import NotSolvedError
from jaxbundle.leastsquares.datum import move_to_datum
from jaxbundle.leastsquares.indices import common, finish
from jaxbundle.leastsquares.plan import Datum, Plan, make_plan
from jaxbundle.leastsquares.problem import (
    Problem,
    fill_data,
    pad_values,
    rounder,
    without_filling,
)
from jaxbundle.leastsquares.rows import Data, Values
from jaxbundle.leastsquares.solver import LeastSquares, Minimum, minimise

AXIS = "devices"
OF_EACH, OF_ALL = PartitionSpec(AXIS), PartitionSpec()
OBSERVATION = 3.0
"""What an observation costs, in units of a pair of incidences."""


@dataclasses.dataclass(frozen=True)
class Shards:
    """A problem in parts; arrays of `plan` and `data` have the device as first axis. `rows`: those
    of the eliminated table on every device, the kept ones on all; `sizes`: of each part."""

    problem: Problem
    rows: tuple[Int[np.ndarray, " n"], ...]
    sizes: dict
    plan: Plan
    data: Data
    mesh: Mesh


def distribute(problem: Problem, devices=None) -> Shards:
    """Cut a problem into as many parts as there are devices (all of JAX's if not given)."""
    devices = jax.devices() if devices is None else devices
    rows, seen = _cut(problem, len(devices))
    planned = [_plan_part(problem, *part) for part in zip(rows, seen)]
    sizes = common((sizes for _, sizes in planned), rounder(problem.observations))
    here, host = dataclasses.replace(problem, sizes=sizes), jax.tree.map(np.asarray, problem.data)
    take = lambda of_sets, mine: tuple(
        jax.tree.map(lambda x, at=at: x[at], one) for one, at in zip(of_sets, mine)
    )
    data = [fill_data(here, Data({}, take(host.measured, m), take(host.weight, m))) for m in seen]
    datum = problem.plan.datum  # What holds it is not asked before the end.
    datum = datum and jax.tree.map(np.asarray, Datum(datum.gauge, {}, datum.pins, {}))
    finished = (finish(plan, sizes) for plan, _ in planned)
    plans = [dataclasses.replace(plan, datum=datum, axis=AXIS) for plan in finished]
    mesh = Mesh(np.array(devices), (AXIS,))
    return Shards(problem, rows, sizes, _place(mesh, plans), _place(mesh, data), mesh)


def find_minimum_of_shards(
    shards: Shards, solver: LeastSquares, start: Values | None = None
) -> Minimum:
    """As `solution.find_minimum`, with the solver of the whole problem; `start` must be finite:
    devices that end at different steps would wait for each other for ever.

    **Raises:** `NotSolvedError` where one of several processes is lost."""
    problem, e = shards.problem, shards.problem.plan.eliminated
    known = jax.tree.map(np.asarray, problem.data.start)
    start = known if start is None else jax.tree.map(np.asarray, start)
    here = dataclasses.replace(problem, sizes=shards.sizes)
    parts = [pad_values(here, _values_of(e, start, rows)) for rows in shards.rows]
    given = shards.plan, shards.data, _place(shards.mesh, parts)
    # Numbers of the host are the same for all processes.
    solver = jax.tree.map(lambda x: np.asarray(x) if eqx.is_array(x) else x, _with(solver, None))
    try:
        minimum = jax.tree.map(np.asarray, _minimise(shards.mesh, solver, given))
    except jax.errors.JaxRuntimeError as error:
        number, why = jax.process_count(), " ".join(str(error).split())[:200]
        if number == 1:
            raise
        raise NotSolvedError(
            f"not solved: one of {number} processes ended, or cannot be reached ({why})"
        ) from None
    values = minimum.values
    if e is not None:
        values = values | {e: jax.tree.map(lambda *x: _together(shards, *x), start[e], values[e])}
    values = pad_values(problem, without_filling(problem, values))
    values = _in_datum(problem.declared, problem.plan, values, pad_values(problem, known))
    values = without_filling(problem, values)
    return jax.device_put(dataclasses.replace(minimum, values=values))


_in_datum = eqx.filter_jit(move_to_datum)


@eqx.filter_jit
def _minimise(mesh: Mesh, solver: LeastSquares, given) -> Minimum:
    """What all devices find; eliminated rows [devices, rows, …]. `given`: their plan, data and
    start."""
    shared, same = eqx.partition(solver, eqx.is_array)
    arrays, static = eqx.partition(given, eqx.is_array)

    def on_device(shared, arrays):
        plan, data, start = eqx.combine(jax.tree.map(lambda x: x[0], arrays), static)
        minimum = minimise(_with(eqx.combine(shared, same), plan), data, start)
        values, e = dict(minimum.values), plan.eliminated
        if e is not None:  # Gathered on all devices: any process reads them.
            values[e] = jax.lax.all_gather(values[e], AXIS)
        return dataclasses.replace(minimum, values=values)

    specs = dict(in_specs=(OF_ALL, OF_EACH), out_specs=OF_ALL)
    return jax.shard_map(on_device, mesh=mesh, check_vma=False, **specs)(shared, arrays)


def _with(solver: LeastSquares, plan: Plan | None) -> LeastSquares:
    return eqx.tree_at(lambda s: s.plan, solver, plan, is_leaf=lambda x: x is None)


def _place(mesh: Mesh, parts):
    """The trees of all devices as one, whose arrays have the device as first axis; every device
    holds its own."""
    spread = NamedSharding(mesh, OF_EACH)

    def one(*x):
        if not isinstance(x[0], np.ndarray):
            return x[0]
        part = lambda index: x[index[0].start or 0][None]
        return jax.make_array_from_callback((len(x), *x[0].shape), spread, part)

    return jax.tree.map(one, *parts)


def _cut(problem: Problem, parts: int):
    """For every device the eliminated rows, and the observations of every set: parts of equal work,
    in their order. Kept rows, and rows that share an observation, are the first's."""
    e, given = problem.plan.eliminated, problem.observations
    if e is None:
        ends = lambda n: np.linspace(0, n, parts + 1).astype(int)
        cuts = zip(*(np.split(np.arange(o.number), ends(o.number)[1:-1]) for o in given))
        return (np.zeros(0, int),) * parts, list(cuts)
    number, stays = problem.table(e).rows, problem.choices["stays",]
    met, tied = np.zeros(number), stays.copy()
    touched = [[r for name, r in zip(o.kind.of, o.rows) if name == e] for o in given]
    for slots in touched:
        for rows in slots:
            met += np.bincount(rows, minlength=number)
            tied[rows] |= len(slots) > 1
    work = np.where(tied, 0.0, met * (met - 1) / 2 + OBSERVATION * met)
    middle = (np.cumsum(work) - work / 2) / max(work.sum(), 1.0)
    owner = np.where(tied, 0, np.minimum((parts * middle).astype(int), parts - 1))
    of_sets = [owner[r[0]] if r else np.zeros(o.number, int) for o, r in zip(given, touched)]
    every = range(parts)
    return (
        tuple(np.flatnonzero(stays | (owner == d)) for d in every),
        [tuple(np.flatnonzero(device == d) for device in of_sets) for d in every],
    )


def _plan_part(problem: Problem, rows, seen):
    """The plan of some eliminated rows and observations, on the host, and its sizes."""
    e, tables, place = problem.plan.eliminated, problem.tables, {}
    groups = problem.plan.groups.items()
    choices = problem.choices | {("all free", name): g.all_free for name, g in groups}
    if e is not None:
        choices["stays",] = choices["stays",][rows]
        place = {e: np.full(problem.table(e).rows, -1)}
        place[e][rows] = np.arange(len(rows))
        cut = lambda t: dataclasses.replace(
            t, value=_values_of(e, {e: t.value}, rows)[e], free=t.free[rows], labels=None
        )
        tables = [cut(t) if t.name == e else t for t in tables]
    of_part = lambda name, at: place[name][at] if name in place else at
    observations = [
        o.kind(tuple(of_part(name, r[at]) for name, r in zip(o.kind.of, o.rows)))
        for o, at in zip(problem.observations, seen)
    ]
    return make_plan(tables, observations, e, choices)[:2]


def _values_of(eliminated, values: Values, rows) -> Values:
    """The values with these of the eliminated rows only."""
    take = lambda x: np.asarray(x)[rows]
    return {n: jax.tree.map(take, x) if n == eliminated else x for n, x in values.items()}


def _together(shards: Shards, whole, parts):
    """The rows of all devices in the order of the whole."""
    whole = np.array(whole)
    for rows, part in zip(shards.rows, parts):
        whole[rows] = part[: len(rows)]
    return whole
