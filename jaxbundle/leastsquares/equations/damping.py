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

from jaxbundle.leastsquares.indexing.plan import Plan
from jaxbundle.leastsquares.indexing.rows import Declared, Values

Metric = dict[str, Float[Array, "rows w *w"]]


def measure(declared: Declared, plan: Plan, values: Values, own) -> Metric:
    """D of every group: matrices [rows, w, w] if a space has a chart, else diagonals [rows, w]; 1
    for held unknowns. `own`: the diagonal blocks of N."""
    return {name: _of_group(declared, plan.groups[name], values, B) for name, B in own.items()}


def _of_group(declared, group, values, blocks):
    charts = []
    for member in group.members:
        rows = values[member.table]
        rows = rows if member.rows is None else jax.tree.map(lambda x, m=member: x[m.rows], rows)
        charts.append(jax.vmap(declared.spaces[member.table].chart)(rows))
    if all(chart is None for chart in charts):
        return _positive(jnp.diagonal(blocks, axis1=1, axis2=2))
    T = inverse = jnp.broadcast_to(jnp.eye(blocks.shape[1]), blocks.shape)
    for member, chart in zip(group.members, charts):
        at = slice(member.start, member.start + member.width)
        if chart is not None:
            T, inverse = T.at[:, at, at].set(chart[0]), inverse.at[:, at, at].set(chart[1])

    def one(T, inverse, N, free):
        D = T.T @ (jnp.diagonal(inverse.T @ N @ inverse)[:, None] * T)
        D = D * free * free[:, None]  # Held unknowns are decoupled from free ones.
        return D + jnp.diag(jnp.where(jnp.diagonal(D) > 0, 0.0, 1.0))

    return jax.vmap(one)(T, inverse, blocks, group.free)


def _positive(diagonal):
    return jnp.where(diagonal > 0, diagonal, 1.0)


def times(D: Metric, change):
    """D·δ."""
    product = lambda d, x: jnp.einsum("nij,nj->ni", d, x) if d.ndim == 3 else d * x
    return {name: product(D[name], x) for name, x in change.items()}


def matrices(D: Metric) -> Metric:
    """D as matrices [rows, w, w]."""
    return {
        name: d if d.ndim == 3 else d[:, :, None] * jnp.eye(d.shape[1]) for name, d in D.items()
    }
