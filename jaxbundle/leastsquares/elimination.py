"""The structured solve: eliminate rows, solve the reduced system, substitute back.

With N = [A W; Wᵀ V] and V block diagonal (Brown 1958; Triggs et al. 2000, section 6.1):

    V = L·Lᵀ,   Z = L⁻¹·Wᵀ,   h = L⁻¹·b_e
    S = A − Zᵀ·Z                      (sums over pairs of incidences of one eliminated row)
    S·x = b − Zᵀ·h                    (`reduced.py`)
    x_e = L⁻ᵀ·(h − Z·x)

Three tiers: the plan is made once a problem, N once an accepted point, this once a damping.
"""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.experimental.layout import Layout, with_layout_constraint
from jaxtyping import Array, Bool, Float

from jaxbundle.leastsquares.damping import matrices
from jaxbundle.leastsquares.normal import Normal, NormalBlocks, Tangent, total
from jaxbundle.leastsquares.plan import PAIR_ROWS_AT_ONCE, Pairs, Plan
from jaxbundle.leastsquares.reduced import DenseFactor, Reduced, factorise_reduced

PIVOT = 1e-13
"""A pivot below this fraction of its diagonal element is rounding: nothing determines it."""


LIFT = 1e-10
"""Added to normal equations that cannot be solved, in parts of their diagonal."""


class Factor(eqx.Module):
    """N factorised: what is needed to solve with it, and to read blocks of its inverse."""

    plan: Plan
    reduced: DenseFactor
    lower_inverse: Float[Array, "rows w w"] | None
    Z: dict[str, Float[Array, "chunks length w v"]]


def damp(normal: Normal, damping: Float[Array, ""]) -> Normal:
    """N + λ·D."""
    N, e = normal.blocks, normal.plan.eliminated
    more = {name: damping * d for name, d in matrices(N.metric).items()}
    own = {name: B + more[name] for name, B in N.own.items()}
    eliminated = None if e is None else N.eliminated + more[e]
    return Normal(normal.plan, dataclasses.replace(N, own=own, eliminated=eliminated))


def lift(normal: Normal) -> Normal:
    """N lifted by a little of its diagonal, so that it can be factorised where it is singular."""
    N, e = normal.blocks, normal.plan.eliminated
    more = lambda B: B + LIFT * jnp.diagonal(B, axis1=1, axis2=2)[:, :, None] * jnp.eye(B.shape[1])
    own = {name: more(B) for name, B in N.own.items()}
    eliminated = None if e is None else more(N.eliminated)
    return Normal(normal.plan, dataclasses.replace(N, own=own, eliminated=eliminated))


def factorise(normal: Normal, regular: Bool[Array, ""] | bool = True) -> Factor:
    """Factorise N, datum directions made regular if `regular`. NaN where a pivot is rounding, as
    where it is negative: chance decides between the two."""
    plan = normal.plan
    parts, lower_inverse, Z = eliminate(plan, normal.blocks)
    factor = factorise_reduced(plan, parts, normal.blocks.own, regular)
    sound = jnp.all(factor.pivots**2 > PIVOT)
    factor = jax.tree.map(
        lambda x: jnp.where(sound, x, jnp.nan) if eqx.is_inexact_array(x) else x, factor
    )
    return Factor(plan, factor, lower_inverse, Z)


def eliminate(plan: Plan, normal: NormalBlocks):
    """S = A − Zᵀ·Z in blocks, L⁻¹ of the eliminated rows, and Z."""
    e = plan.eliminated
    own, off = dict(normal.own), dict(normal.off)
    if e is None:
        return Reduced(own, off), None, {}
    held = (1.0 - plan.groups[e].free)[:, :, None] * jnp.eye(plan.groups[e].width)
    L = inverse_cholesky(normal.eliminated + held)
    Z, less, less_off = {}, {}, {}
    for g, W in normal.W.items():
        at = plan.incidences[g]
        Z[g] = _row_major(_lower_times(L, at.eliminated, W))
        rows = Z[g].reshape(at.row.shape[0], -1, W.shape[-1])
        less[g] = jax.ops.segment_sum(
            jnp.einsum("cki,ckj->cij", rows, rows), at.row, own[g].shape[0]
        )
    for key, at in plan.blocks.items():
        if at.pairs is not None:
            less_off[key] = sum_pairs(at.pairs, at.row.shape[0], Z[key[0]], Z[key[1]])
    less, less_off = total(plan, (less, less_off))
    own = {g: B - less[g] if g in less else B for g, B in own.items()}
    for key, B in less_off.items():
        off[key] = off[key] - B if key in off else -B
    return Reduced(own, off), L, Z


def solve(factor: Factor, right: Tangent) -> Tangent:
    """N⁻¹·b for one right-hand side, linear and transposable in b."""
    plan, e = factor.plan, factor.plan.eliminated
    kept = {g: right[g] * plan.groups[g].free for g in plan.kept}
    if e is not None:
        free = plan.groups[e].free
        h = jnp.einsum("nij,nj->ni", factor.lower_inverse, right[e] * free)
        less = {g: _gather(plan, g, Z, h) for g, Z in factor.Z.items()}
        for g, x in total(plan, less).items():
            kept[g] = kept[g] - x
    x = factor.reduced.solve(kept)
    x = {g: rows * plan.groups[g].free for g, rows in x.items()}
    if e is not None:
        for g, Z in factor.Z.items():
            h = h - _scatter(plan, g, Z, x[g])
        x[e] = jnp.einsum("nji,nj->ni", factor.lower_inverse, h) * free
    return x


def _gather(plan: Plan, g: str, Z, h):
    """Zᵀ·h."""
    at = plan.incidences[g]
    rows = Z.reshape(at.row.shape[0], -1, Z.shape[-1])
    of_chunks = jnp.einsum("cki,ck->ci", rows, h[at.eliminated].reshape(rows.shape[:2]))
    return jax.ops.segment_sum(of_chunks, at.row, plan.groups[g].rows)


def _scatter(plan: Plan, g: str, Z, x):
    """Z·x."""
    at = plan.incidences[g]
    rows = Z.reshape(at.row.shape[0], -1, Z.shape[-1])
    moved = jnp.einsum("cki,ci->ck", rows, x[at.row]).reshape(-1, Z.shape[-2])
    return jax.ops.segment_sum(moved, at.eliminated.ravel(), plan.groups[plan.eliminated].rows)


def sum_pairs(pairs: Pairs, blocks: int, a, b) -> Float[Array, "blocks w v"]:
    """Σ aᵀb over the pairs of every block: chunk by chunk one small matrix product of depth
    (length × w). A quarter of the time of outer products that are scattered."""
    a, b = (x.reshape(-1, *x.shape[2:]) for x in (a, b))
    depth, m, n = a.shape[1], a.shape[2], b.shape[2]
    sums = jnp.zeros((blocks, m, n))
    for first, second, block in zip(pairs.first, pairs.second, pairs.block):
        length = first.shape[1]

        def add(sums, chunk, rows=length * depth):
            i, j, k = chunk
            left, right = a[i].reshape(-1, rows, m), b[j].reshape(-1, rows, n)
            product = jnp.einsum("cki,ckj->cij", left, right)
            return sums.at[k].add(product, indices_are_sorted=True), None

        chunks, step = first.shape[0], max(1, PAIR_ROWS_AT_ONCE // length)
        whole = chunks // step * step
        if chunks > step:
            steps = lambda x, n=whole, step=step: x[:n].reshape(-1, step, *x.shape[1:])
            sums, _ = jax.lax.scan(add, sums, (steps(first), steps(second), steps(block)))
            first, second, block = first[whole:], second[whole:], block[whole:]
        if len(block):
            sums, _ = add(sums, (first, second, block))
    return sums


def inverse_cholesky(V: Float[Array, "n w w"]) -> Float[Array, "n w w"]:
    """L⁻¹ of V = L·Lᵀ, written out over scalars (7 ns a row of three; a batched Cholesky takes
    60); NaN where V is not positive definite."""
    w = V.shape[-1]
    L, M = {}, {}
    for j in range(w):
        pivot = V[:, j, j] - sum(L[j, k] ** 2 for k in range(j))
        M[j, j] = jax.lax.rsqrt(jnp.where(pivot > PIVOT * V[:, j, j], pivot, jnp.nan))
        for i in range(j + 1, w):
            L[i, j] = (V[:, i, j] - sum(L[i, k] * L[j, k] for k in range(j))) * M[j, j]
    for j in range(w):
        for i in range(j + 1, w):
            M[i, j] = -sum(L[i, k] * M[k, j] for k in range(j, i)) * M[i, i]
    zero = jnp.zeros_like(V[:, 0, 0])
    rows = [jnp.stack([M.get((i, j), zero) for j in range(w)], -1) for i in range(w)]
    return jnp.stack(rows, -2)


def _lower_times(L, at, W):
    """L[at]·W of every incidence, L lower triangular; written out: half the time of a product."""
    w = L.shape[-1]
    of = L.reshape(-1, w * w)[at]
    row = lambda i: sum(of[..., w * i + j, None] * W[..., j, :] for j in range(i + 1))
    return jnp.stack([row(i) for i in range(w)], -2)


def _row_major(x):
    """Blocks in row-major order. Left alone, XLA lays a shared array out to suit one of its readers
    (the product by chunks), and the gathers of the pairs take three times as long."""
    return with_layout_constraint(x, Layout(major_to_minor=tuple(range(x.ndim))))
