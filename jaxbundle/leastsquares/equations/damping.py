"""The damping matrix: λ·D is added to N; the step becomes shorter as λ grows.

Marquardt (1963) takes D = diag(N), which depends on the choice of unknowns. A space may define
other unknowns for the damping (`Space.chart`): D is diag(N) in these, transformed back,

    D = Tᵀ·diag(T⁻ᵀ·N·T⁻¹)·T,   T = ∂(chart)/∂(unknowns).

Without a chart D is a diagonal. Identity damping does not converge on real problems, which mix
radians, metres and coefficients of 1e-8.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxbundle.leastsquares.indexing.plan import Plan, Tangent, UnknownGroup
from jaxbundle.leastsquares.indexing.rows import Declared, Values

DampingMatrix = dict[str, Float[Array, "rows w *w"]]


def damping_matrix(
    declared: Declared,
    plan: Plan,
    values: Values,
    diagonal_blocks: dict[str, Float[Array, "rows w w"]],
) -> DampingMatrix:
    """D of every group: matrices [rows, w, w] if a space has a chart, else diagonals [rows, w]; 1
    for held unknowns. `diagonal_blocks`: the diagonal blocks of N."""
    return {
        name: _damping_of_group(declared, plan.groups[name], values, B)
        for name, B in diagonal_blocks.items()
    }


def _damping_of_group(
    declared: Declared, group: UnknownGroup, values: Values, blocks: Float[Array, "rows w w"]
) -> Float[Array, "rows w *w"]:
    """D of one group."""
    charts = []
    for member in group.members:
        rows = values[member.table]
        rows = rows if member.rows is None else jax.tree.map(lambda x, m=member: x[m.rows], rows)
        charts.append(jax.vmap(declared.spaces[member.table].chart)(rows))
    if all(chart is None for chart in charts):
        diagonal = jnp.diagonal(blocks, axis1=1, axis2=2)
        return jnp.where(diagonal > 0, diagonal, 1.0)
    # A group may hold several tables (a pose and its camera): each with its own chart, or none.
    T = inverse = jnp.broadcast_to(jnp.eye(blocks.shape[1]), blocks.shape)
    for member, chart in zip(group.members, charts):
        columns = slice(member.start, member.start + member.width)
        if chart is not None:
            T, inverse = (
                T.at[:, columns, columns].set(chart[0]),
                inverse.at[:, columns, columns].set(chart[1]),
            )

    def damping_of_row(
        T: Float[Array, "w w"],
        inverse: Float[Array, "w w"],
        N: Float[Array, "w w"],
        free: Float[Array, " w"],
    ) -> Float[Array, "w w"]:
        # Tᵀ·diag(M)·T with M = T⁻ᵀ·N·T⁻¹, N in the unknowns of the chart.
        D = T.T @ (jnp.diagonal(inverse.T @ N @ inverse)[:, None] * T)
        D = D * free * free[:, None]  # Held unknowns are decoupled from free ones.
        return D + jnp.diag(jnp.where(jnp.diagonal(D) > 0, 0.0, 1.0))

    return jax.vmap(damping_of_row)(T, inverse, blocks, group.free)


def times(D: DampingMatrix, change: Tangent) -> Tangent:
    """D·δ."""
    product = lambda d, x: jnp.einsum("nij,nj->ni", d, x) if d.ndim == 3 else d * x
    return {name: product(D[name], x) for name, x in change.items()}


def matrices(D: DampingMatrix) -> DampingMatrix:
    """D as matrices [rows, w, w]."""
    return {
        name: d if d.ndim == 3 else d[:, :, None] * jnp.eye(d.shape[1]) for name, d in D.items()
    }
