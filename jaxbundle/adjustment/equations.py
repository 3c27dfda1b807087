"""The observation equations of a network as functions: residuals, and their derivatives."""

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float

from jaxbundle.adjustment.problem import Problem
from jaxbundle.leastsquares.indexing.rows import lay_out_data, restore_order
from jaxbundle.leastsquares.indexing.rows import residuals as residuals_of_parts
from jaxbundle.leastsquares.problem import pad_data, pad_values
from jaxbundle.leastsquares.quality.names import Name
from jaxbundle.network.arrays import Data, Values
from jaxbundle.network.declare import Rows


def residuals(problem: Problem, values: Values, data: Data | None = None) -> Rows:
    """v/σ of every observation and pseudo-observation, in the order of `Data`; a pure function of
    the values and the numbers."""
    data = problem.data if data is None else data
    return problem.layout.rows(_by_set(problem, problem.layout.tables(values), data), data)


def design_matrix(
    problem: Problem, values: Values, data: Data | None = None
) -> tuple[Float[Array, "rows unknowns"], list[Name]]:
    """J = ∂(v/σ)/∂(free unknowns), dense, for small networks, and the unknowns of its columns.

    Rows are ordered by set (image points, control points, priors, distances), columns by table.
    Rotations change by δθ (radians) about the camera axes."""
    system, layout = problem.system, problem.layout
    data = problem.data if data is None else data
    tables = layout.tables(values)
    places = [(t, row, column) for t in system.tables for row, column in zip(*np.nonzero(t.free))]
    still, unravel = ravel_pytree(
        {t.name: jnp.zeros((t.rows, t.space.width)) for t in system.tables}
    )
    which = ravel_pytree({t.name: jnp.asarray(t.free) for t in system.tables})[0]
    free = np.flatnonzero(which)

    def rows(change):
        moved = dict(tables)
        for name, d in unravel(still.at[free].set(change)).items():
            space = system.declared.spaces[name]
            moved[name] = jax.vmap(space.retract)(tables[name], d)
        return jnp.concatenate([x.ravel() for x in _by_set(problem, moved, data).values()])

    order = {name: i for i, name in enumerate(sorted(t.name for t in system.tables))}
    places.sort(key=lambda place: order[place[0].name])
    names = [Name(t.title, t.label(int(r)), t.parameter(int(c))) for t, r, c in places]
    return jax.jit(jax.jacfwd(rows))(jnp.zeros(len(free))), names


def _by_set(problem: Problem, tables, data: Data):
    system = problem.system
    given = pad_data(system, problem.layout.data(data))
    laid = lay_out_data(system.plan, given)
    parts = residuals_of_parts(system.declared, system.plan, pad_values(system, tables), laid)
    rows = restore_order(system.plan, parts)
    return {o.name: rows[o.name][: o.number] for o in system.observations}
