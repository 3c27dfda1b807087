"""Products with the exact Hessian of ½vᵀPv, from the derivatives of single observations."""

from collections.abc import Mapping, Sequence

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxbundle.leastsquares.equations.hessian import SecondOrder
from jaxbundle.leastsquares.equations.linearise import widths_of
from jaxbundle.leastsquares.equations.normal import Rows
from jaxbundle.leastsquares.indexing.plan import ObservationPart, Plan, Tangent
from jaxbundle.leastsquares.indexing.rows import Declared, Values
from jaxbundle.leastsquares.iterations.retraction import changes_of_tables


def multiply(
    declared: Declared, plan: Plan, values: Values, terms: Sequence[SecondOrder], change: Tangent
) -> Tangent:
    """H·δ, observation by observation: Σ Jᵀ·(J·δ) + curvature·δ.

    Without H, whose elements have lost the digits that JᵀJ loses. The derivative of the gradient
    along δ is the same, but for four photographs its program takes 3.5 s to compile, this one 0.2:
    the derivatives are there already (`equations_and_terms`)."""

    def by_observation(change: Tangent) -> tuple[Float[Array, "chunks length n"], ...]:
        free = {name: rows * plan.groups[name].free for name, rows in change.items()}
        moves = changes_of_tables(plan, values, free)
        return tuple(_look_up_changes(declared, part, moves) for part in plan.parts)

    products = tuple(
        _multiply_each(found, delta)
        for found, delta in zip(terms, by_observation(change), strict=True)
    )
    return jax.linear_transpose(by_observation, change)(products)[0]


def _look_up_changes(
    declared: Declared, part: ObservationPart, moves: Mapping[str, Rows]
) -> Float[Array, "chunks length n"]:
    """The changes of all directions of the slots of every observation; 0 for tables at rest."""
    changes = []
    for name, rows, width in zip(
        declared.kinds[part.set_name].of, part.lookup, widths_of(declared, part)
    ):
        shape = (*part.source.shape, width)
        # Rows looked up by chunk are those of all of its observations.
        change = moves[name][rows if rows.ndim == 2 else rows[:, None]] if name in moves else 0.0
        if width:
            changes.append(jnp.broadcast_to(change, shape))
    return jnp.concatenate(changes, -1)


def _multiply_each(
    derivatives: SecondOrder, delta: Float[Array, "chunks length n"]
) -> Float[Array, "chunks length n"]:
    # Without the zeros at the end.
    J, curvature = derivatives.jacobian[..., :-1], derivatives.curvature[..., :-1, :-1]
    first_order = jnp.einsum("clri,cli->clr", J, delta)
    return jnp.einsum("clri,clr->cli", J, first_order) + jnp.einsum(
        "clij,clj->cli", curvature, delta
    )
