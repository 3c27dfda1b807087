"""Minimisation on several devices: eliminated rows are distributed with their observations.

Every device eliminates its own rows. Kept rows are on all devices: their sums, the reduced
matrix and its right-hand side are added up over the devices (`normal.sum_over_devices`), and every
device solves the reduced system and updates its rows. Observations without an eliminated row belong
to the first device. The same program runs on the cores of a processor (`jax_num_cpu_devices`), on
several GPUs, and in several processes after `jax.distributed.initialize`.
"""

import dataclasses
from collections.abc import Hashable, Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Any

import equinox as eqx
import jax
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from jaxtyping import Int, PyTree

from jaxbundle.errors import NotSolvedError
from jaxbundle.leastsquares.declarations import Table
from jaxbundle.leastsquares.indexing.indices import Sizes, common, finish
from jaxbundle.leastsquares.indexing.plan import Datum, Plan
from jaxbundle.leastsquares.indexing.planner import make_plan
from jaxbundle.leastsquares.indexing.rows import Data, Values
from jaxbundle.leastsquares.iterations.solver import LeastSquares, Minimum, minimise
from jaxbundle.leastsquares.problem import (
    Problem,
    choose_rounding,
    fill_data,
    pad_values,
    without_filling,
)
from jaxbundle.system.programs import compile_once
from jaxbundle.types import AnyArray, not_none

AXIS = "devices"
_ALONE = ContextVar("alone", default=False)


@dataclasses.dataclass(frozen=True)
class Shards:
    """A problem in parts; arrays of `plan` and `data` have the device as first axis. `rows`: those
    of the eliminated table on every device, the kept ones on all; `sizes`: of the lists of a plan,
    common to all parts."""

    problem: Problem
    rows: tuple[Int[np.ndarray, " n"], ...]
    sizes: dict
    plan: Plan
    data: Data
    mesh: Mesh


@contextmanager
def use_own_devices() -> Iterator[None]:
    """Problems solved in this context belong to this process only: its own devices share them."""
    token = _ALONE.set(True)
    try:
        yield
    finally:
        _ALONE.reset(token)


def sharing_devices() -> list:
    """The devices that share a problem."""
    return jax.local_devices() if _ALONE.get() else jax.devices()


def distribute(problem: Problem, devices: list | None = None) -> Shards:
    """Cut a problem with an eliminated table into a part for every device."""
    devices = sharing_devices() if devices is None else devices
    # Every part is planned as a problem of its own, with the choices of the whole: chunk lengths,
    # groups and blocks are the same on all devices, which run one program.
    rows, observed = _share_rows(problem, len(devices))
    planned = [_plan_part(problem, *part) for part in zip(rows, observed)]
    sizes = common(
        (sizes for _, sizes in planned), choose_rounding(problem.observations, problem.planning)
    )
    part_problem, host = (
        dataclasses.replace(problem, sizes=sizes),
        jax.tree.map(np.asarray, problem.data),
    )
    take = lambda of_sets, at: {o: _take(of_sets[o], rows) for o, rows in at.items()}
    data = [
        fill_data(part_problem, Data({}, take(host.measured, m), take(host.weight, m)))
        for m in observed
    ]
    datum = problem.plan.datum  # The datum is applied only at the end.
    datum = datum and jax.tree.map(np.asarray, Datum(datum.gauge, {}, datum.pins, {}))
    complete = lambda plan: dataclasses.replace(finish(plan, sizes), datum=datum, axis=AXIS)
    mesh, plans = Mesh(np.array(devices), (AXIS,)), [complete(plan) for plan, _ in planned]
    return Shards(problem, rows, sizes, _place(mesh, plans), _place(mesh, data), mesh)


def find_minimum_of_shards(
    shards: Shards, solver: LeastSquares, start: Values | None = None
) -> Minimum[Values]:
    """As `solver.minimise`, with the solver of the whole problem; values are not moved to the
    datum. `start` must be finite: devices that end at different steps would deadlock.

    **Raises:** `NotSolvedError` if one of several processes is lost."""
    problem, e = shards.problem, not_none(shards.problem.plan.eliminated)
    part_problem = dataclasses.replace(problem, sizes=shards.sizes)
    start_values = jax.tree.map(np.asarray, problem.data.start if start is None else start)
    part = lambda rows: pad_values(part_problem, start_values | {e: _take(start_values[e], rows)})
    parts = _place(shards.mesh, [part(rows) for rows in shards.rows])
    solver = dataclasses.replace(solver, plan=shards.plan)
    try:
        minimum = jax.tree.map(np.asarray, _minimise(shards.mesh, solver, shards.data, parts))
    except jax.errors.JaxRuntimeError as error:
        number, why = jax.process_count(), " ".join(str(error).split())[:200]
        if number == 1:
            raise
        raise NotSolvedError(
            f"not solved: one of {number} processes ended, or cannot be reached ({why})"
        ) from None
    # Kept rows come from all devices, identical: the first one counts.
    _, positions = np.unique(np.concatenate(shards.rows), return_index=True)
    unsharded = lambda x: np.concatenate([x[d, : len(rows)] for d, rows in enumerate(shards.rows)])[
        positions
    ]
    values = minimum.values | {e: jax.tree.map(unsharded, minimum.values[e])}
    return dataclasses.replace(minimum, values=without_filling(problem, values))


@compile_once
def _minimise(mesh: Mesh, solver: LeastSquares, data: Data, start: Values) -> Minimum[Values]:
    """The results of all devices; eliminated rows [devices, rows, …]."""
    # The device axis is the first of every array; on a device it is 1 and is taken off.
    arrays, static = eqx.partition((solver.plan, data, start), eqx.is_array)

    def on_device(arrays: PyTree) -> Minimum[Values]:
        plan, data, start = eqx.combine(jax.tree.map(lambda x: x[0], arrays), static)
        minimum = minimise(dataclasses.replace(solver, plan=plan), data, start)
        e, values = plan.eliminated, minimum.values  # Gathered, so that any process reads them.
        values = values | {e: jax.lax.all_gather(values[e], AXIS)}
        return dataclasses.replace(minimum, values=values)

    sharded, replicated = PartitionSpec(AXIS), PartitionSpec()
    run = jax.shard_map(
        on_device, mesh=mesh, in_specs=sharded, out_specs=replicated, check_vma=False
    )
    return run(arrays)


def _place(mesh: Mesh, parts: Sequence[PyTree]) -> Any:
    """The arrays of all parts with the device as first axis; every device holds its own."""
    sharding = NamedSharding(mesh, PartitionSpec(AXIS))

    def make(*x: np.ndarray) -> jax.Array:
        # Every process makes the parts of its own devices only.
        part_of_device = lambda at: x[0 if at is None else at[0].start or 0][None]
        return jax.make_array_from_callback((len(x), *x[0].shape), sharding, part_of_device)

    return jax.tree.map(make, *parts)


def _share_rows(
    problem: Problem, parts: int
) -> tuple[tuple[Int[np.ndarray, " n"], ...], list[dict[str, Int[np.ndarray, " n"]]]]:
    """For every device the eliminated rows, and the observations of every set: parts of equal work,
    in order. Observations of kept rows alone, and of rows that share an observation, belong to the
    first device."""
    e, observation_sets = problem.plan.eliminated, problem.observations
    touched_rows = [
        [r for name, r in zip(o.kind.of, o.rows) if name == e] for o in observation_sets
    ]
    stays = problem.choices["coupled rows",]
    number_of_rays, is_coupled = np.zeros(len(stays)), stays.copy()
    for slots in touched_rows:
        for rows in slots:
            number_of_rays += np.bincount(rows, minlength=len(stays))
            is_coupled[rows] |= len(slots) > 1
    # An observation costs as much as three to four pairs of incidences: BAL 16, one core, 24 ms for
    # the derivatives, sums and residuals of 83 718 observations, 14 ms for 170 046 pairs: 3.5. It
    # matters for the balance of the devices alone.
    work = np.where(
        is_coupled, 0.0, number_of_rays * (number_of_rays - 1) / 2 + 3.0 * number_of_rays
    )
    # A row belongs to the device in whose equal share of the work its middle lies: contiguous rows,
    # whose observations were laid out together.
    middle = (np.cumsum(work) - work / 2) / max(work.sum(), 1.0)
    owner = np.where(is_coupled, 0, np.minimum((parts * middle).astype(int), parts - 1))
    owners = {
        o.name: owner[r[0]] if r else np.zeros(o.number, int)
        for o, r in zip(observation_sets, touched_rows)
    }
    observations_of = [
        {o: np.flatnonzero(of == d) for o, of in owners.items()} for d in range(parts)
    ]
    return tuple(np.flatnonzero(stays | (owner == d)) for d in range(parts)), observations_of


def _plan_part(
    problem: Problem, rows: Int[np.ndarray, " n"], observed: dict[str, Int[np.ndarray, " m"]]
) -> tuple[Plan, Sizes]:
    """The plan of some eliminated rows and observations, on the host, and its sizes."""
    e, groups = not_none(problem.plan.eliminated), problem.plan.groups.items()
    # The masks of the whole problem, too: a part in which all rows happen to be free would be
    # another program.
    free = {("all free", name): group.all_free for name, group in groups}
    choices: dict[Hashable, Any] = {**problem.choices, **free}
    choices["coupled rows",] = choices["coupled rows",][rows]
    row = np.full(problem.table(e).rows, -1)
    row[rows] = np.arange(len(rows))
    rows_of_table = lambda t: Table(t.name, _take(t.value, rows), t.space, t.free[rows])
    tables = [rows_of_table(t) if t.name == e else t for t in problem.tables]
    rows_of = lambda o, at: [row[r[at]] if t == e else r[at] for t, r in zip(o.kind.of, o.rows)]
    observations = [o.kind(rows_of(o, observed[o.name]), name=o.name) for o in problem.observations]
    return make_plan(tables, observations, e, choices)[:2]


def _take(tree: PyTree[AnyArray], rows: Int[np.ndarray, " n"]) -> PyTree[np.ndarray]:
    return jax.tree.map(lambda x: np.asarray(x)[rows], tree)
