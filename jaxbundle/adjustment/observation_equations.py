"""The observation equations of a problem as functions: residuals, and their derivatives."""

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float

from jaxbundle.leastsquares.indexing.rows import Data, Values, lay_out_data, restore_order
from jaxbundle.leastsquares.indexing.rows import residuals as residuals_of_parts
from jaxbundle.leastsquares.problem import Problem, pad_data, pad_values
from jaxbundle.leastsquares.quality.names import Name


def residuals(
    problem: Problem, values: Values, data: Data | None = None
) -> dict[str, Float[Array, "n r"]]:
    """v/σ of every observation and pseudo-observation by set; a pure function of the values and the
    numbers."""
    padded = pad_data(problem, problem.data if data is None else data)
    chunked = lay_out_data(problem.plan, padded)
    wide = pad_values(problem, values)
    parts = residuals_of_parts(problem.declared, problem.plan, wide, chunked)
    rows = restore_order(problem.plan, parts)
    return {o.name: rows[o.name][: o.number] for o in problem.observations}


def design_matrix(
    problem: Problem, values: Values, data: Data | None = None
) -> tuple[Float[Array, "rows unknowns"], list[Name]]:
    """J = ∂(v/σ)/∂(free unknowns), dense, for small problems, and the unknowns of its columns.

    Rows are ordered by set of observations, columns by table. Rotations change by δθ (radians)
    about the camera axes."""
    places = [(t, row, column) for t in problem.tables for row, column in zip(*np.nonzero(t.free))]
    zero_change, unravel = ravel_pytree(
        {t.name: jnp.zeros((t.rows, t.space.width)) for t in problem.tables}
    )
    # The engine never forms this matrix; here J is one forward pass per unknown, for tests and for
    # readers who want to see it.
    which = ravel_pytree({t.name: jnp.asarray(t.free) for t in problem.tables})[0]
    free = np.flatnonzero(which)

    def rows(change: Float[Array, " unknowns"]) -> Float[Array, " rows"]:
        tables = dict(values)
        for name, d in unravel(zero_change.at[free].set(change)).items():
            space = problem.declared.spaces[name]
            tables[name] = jax.vmap(space.retract)(values[name], d)
        return jnp.concatenate([x.ravel() for x in residuals(problem, tables, data).values()])

    order = {name: i for i, name in enumerate(sorted(t.name for t in problem.tables))}
    places.sort(key=lambda place: order[place[0].name])
    names = [Name(t.title, t.label(int(r)), t.parameter(int(c))) for t, r, c in places]
    return jax.jit(jax.jacfwd(rows))(jnp.zeros(len(free))), names
