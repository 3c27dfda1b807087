"""The retraction: applying a small change of the groups to the tables."""

import jax
import jax.numpy as jnp

from jaxbundle.leastsquares.equations.normal import AnyTangent, Rows
from jaxbundle.leastsquares.indexing.plan import Plan, Tangent
from jaxbundle.leastsquares.indexing.rows import Declared, Values
from jaxbundle.leastsquares.spaces import Frame


def retract(declared: Declared, plan: Plan, values: Values, change: Tangent) -> Values:
    """The tables after a change; held unknowns must have a zero change."""
    return retract_tables(declared, values, changes_of_tables(plan, values, change))


def retract_tables(declared: Declared, values: Values, changes: dict[str, Rows]) -> Values:
    """The tables after a change of each, [rows, width]."""
    tables = dict(values)
    for name, rows in changes.items():
        tables[name] = jax.vmap(declared.spaces[name].retract)(values[name], rows)
    return tables


def changes_of_tables(plan: Plan, values: Values, change: AnyTangent) -> dict[str, Rows]:
    """The change of every table that moves, [rows, width]."""
    changes: dict[str, Rows] = {}
    for name, group in plan.groups.items():
        for member in group.members:
            part = change[name][:, member.start : member.start + member.width]
            # Rows of the table that are in no group, held or in another group, do not change.
            if member.rows is not None:
                rows = jax.tree.leaves(values[member.table])[0].shape[0]
                part = jnp.zeros((rows, member.width)).at[member.rows].add(part)
            # A table may be in two groups: eliminated rows, and those that are kept.
            sum_of_parts = changes.get(member.table)
            changes[member.table] = part if sum_of_parts is None else sum_of_parts + part
    return changes


def representatives(declared: Declared, values: Values, start: Values) -> Values:
    """The tables with what does not change them (a plane moved in itself) as near to `start` as
    possible: a function of the figures and `start` alone, not of the path of the iterations."""
    frames = {n: space for n, space in declared.named_spaces if isinstance(space, Frame)}
    nearest = {n: jax.vmap(s.representative)(values[n], start[n]) for n, s in frames.items()}
    return values | nearest
