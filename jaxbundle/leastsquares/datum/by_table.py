"""Motions of tables, by one program per table, called on the host.

Tables of one space and size share a program, and so do all small ones, padded to one size. A
program for a whole problem would be compiled again for every other shape.
"""

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

import jax
import numpy as np
from jaxtyping import Array, Float

from jaxbundle.leastsquares.datum import conditions as datum
from jaxbundle.leastsquares.datum.motions import JointMotion, move_at_once
from jaxbundle.leastsquares.declarations import Motions
from jaxbundle.leastsquares.indexing.plan import Plan, Tangent
from jaxbundle.leastsquares.indexing.rows import Declared, Values
from jaxbundle.leastsquares.spaces import Space
from jaxbundle.system.programs import compile_once
from jaxbundle.types import AnyArray, not_none

# The name of a table treated alone.
TABLE_ALONE = "table"


def directions_of_motions(declared: Declared, values: Values) -> Tangent:
    """`datum.generators` of all tables: [rows, width, motions]."""
    directions, motions_of_space = {}, not_none(declared.motions)
    for name, value in values.items():
        action = tuple(
            (TABLE_ALONE, act) for table, act in motions_of_space.actions if table == name
        )
        if not action:
            rows = len(jax.tree.leaves(value)[0])
            directions[name] = np.zeros(
                (rows, declared.spaces[name].width, len(motions_of_space.names))
            )
            continue
        # A declaration of this table alone, equal for all of its kind: the key of the shared
        # program.
        motions = Motions(motions_of_space.names, action)
        table_alone = Declared((), ((TABLE_ALONE, declared.spaces[name]),), motions)
        directions_of_rows = lambda rows, table_alone=table_alone: _generators(
            table_alone, {TABLE_ALONE: rows}
        )[TABLE_ALONE]
        directions[name] = _of_rows(directions_of_rows, value)
    return directions


def move_into_datum(
    declared: Declared, plan: Plan, values: Values, start: Values
) -> tuple[Values, bool]:
    """`datum.move_to_datum` by Gauss–Newton steps only."""
    if plan.datum is None:
        return values, True
    if plan.datum.turned:
        start = _turn_start(declared, plan, values, start)
    if plan.datum.held:
        held_directions = directions_of_motions(
            declared, {name: values[name] for name in plan.datum.held}
        )
        plan = _keep_held_fixed(declared, plan, values, held_directions)
    host_datum = jax.tree.map(np.asarray, not_none(plan.datum))
    curved, free = not_none(declared.motions).curved, _free(declared, plan, values)
    size = float(datum.largest(host_datum.weight, start))

    def one_step(values: Values) -> tuple[Values, float]:
        tables = {name: values[name] for name in host_datum.weight}
        moves = directions_of_motions(declared, tables)
        offset = {
            name: _of_rows(partial(_difference, declared.spaces[name]), value, start[name])
            for name, value in tables.items()
        }
        misclosure, slope = datum.datum_conditions(host_datum, moves, offset)
        step = datum.limit_step(host_datum.gauge @ -np.linalg.solve(slope, misclosure), curved)
        displaced = _move_tables(declared, free, step, values)
        change = {
            name: jax.tree.map(np.subtract, displaced[name], values[name])
            for name in host_datum.weight
        }
        return displaced, float(datum.largest(host_datum.weight, change))

    # Larger than any step, so that the first one is taken.
    distance, previous_distance, count = 1e300, np.inf, 0
    with np.errstate(all="ignore"):
        while datum.moves_on(size, distance, previous_distance, count):
            try:
                displaced, new = one_step(values)
            except np.linalg.LinAlgError:
                return values, False
            values, distance, previous_distance, count = displaced, new, distance, count + 1
    return values, distance <= datum.DATUM_MOTION.reached * size


def _move_tables(
    declared: Declared,
    free: Mapping[str, AnyArray],
    motion: Float[AnyArray, " motions"],
    values: Values,
) -> Values:
    """All tables moved, except held values."""
    displaced = dict(values)
    for name, act in not_none(declared.motions).actions:
        table_motion = motion
        if isinstance(act, JointMotion):
            act, table_motion = act.move, _move_at_once(act.transform, motion, act.size)
        of_rows = partial(_move, declared.spaces[name], act, table_motion)
        displaced[name] = _of_rows(of_rows, values[name], free[name])
    return displaced


@compile_once
def _difference(space: Space, values: Any, origin: Any) -> Float[Array, "rows width"]:
    return jax.vmap(space.difference)(values, origin)


@compile_once
def _move(
    space: Space,
    act: Callable,
    motion: Float[AnyArray, " motions"],
    values: Any,
    free: Float[Array, "rows width"],
) -> Any:
    move_row = lambda value, f: space.hold(act(motion, value), value, f)
    return jax.vmap(move_row)(values, free)


def _of_rows(program: Callable, *arguments: Any) -> Any:
    """A program on the rows of a table, padded and cut again; in NumPy."""
    rows = jax.tree.leaves(arguments)[0].shape[0]
    # 128 rows: cameras and stations of most networks in one program; half or double only moves
    # where a second one is compiled.
    missing_rows = max(128 - rows, 0)
    wide = lambda x: np.pad(x, [(0, missing_rows), *[(0, 0)] * (np.ndim(x) - 1)], mode="edge")
    return jax.tree.map(lambda x: np.asarray(x)[:rows], program(*jax.tree.map(wide, arguments)))


_generators = compile_once(datum.generators)
_keep_held_fixed = compile_once(datum.keep_held_fixed)
_turn_start = compile_once(datum.turn_start)
_free = compile_once(datum.free_of_tables)
_move_at_once = compile_once(move_at_once)
