"""Observations without derivatives: a distance of 0, an angle of 180°.

One such row makes every step undefined, so that nothing is accepted and no unknown is to blame.
"""

import dataclasses
from collections.abc import Collection, Iterator

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxbundle.leastsquares.indexing.plan import Tangent
from jaxbundle.leastsquares.indexing.rows import (
    Values,
    fill_places,
    lay_out_data,
    residuals,
    restore_order,
)
from jaxbundle.leastsquares.iterations.retraction import retract
from jaxbundle.leastsquares.problem import Problem, complete_data


def without_derivatives(problem: Problem, values: Values, sets: Collection[str]) -> Iterator[str]:
    """The observations of these sets, in words, whose residuals or derivatives are not finite at
    `values`."""
    data = complete_data(problem, dataclasses.replace(problem.data, start=values))
    plan, chunked = fill_places(problem.plan, lay_out_data(problem.plan, data))
    # Any direction that moves every free unknown shows them.
    all_free = {name: group.free for name, group in problem.plan.groups.items()}

    def residuals_after(change: Tangent) -> tuple[Float[Array, "chunks length r"], ...]:
        tables = retract(problem.declared, plan, data.start, change)
        return residuals(problem.declared, plan, tables, chunked)

    zero_change = jax.tree.map(jnp.zeros_like, all_free)
    parts = [
        abs(v) + abs(dv) for v, dv in zip(*jax.jvp(residuals_after, (zero_change,), (all_free,)))
    ]
    sizes = restore_order(plan, parts)
    for observation_set in (o for o in problem.observations if o.name in sets):
        # Rows behind the observations fill up the size of the program.
        finite = np.isfinite(np.asarray(sizes[observation_set.name])[: observation_set.number]).all(
            1
        )
        for row in np.flatnonzero(~finite):
            yield observation_set.label(problem.tables, int(row))
