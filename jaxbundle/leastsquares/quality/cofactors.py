"""Cofactors: only those blocks of the inverse normal matrix that statistics need.

From the factor (`elimination.py`), with Q the inverse of S and Z = L⁻¹·Wᵀ of every incidence,

    K_n  = Σ_m Z_m·Q[m, n]              over the incidences m of the same eliminated row
    Q_en = −L⁻ᵀ·K_n                     an eliminated row with the kept row of its incidence n
    Q_ee = L⁻ᵀ·(1 + Σ_n K_n·Z_nᵀ)·L⁻¹   an eliminated row

These are marginal cofactors: those of eliminated rows include the uncertainty of kept rows. In a
problem that may float they refer to the datum by the S-transformation Q ← S·Q·Sᵀ.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxbundle.leastsquares.datum.conditions import (
    contract,
    datum_directions,
    s_transform_transposed,
    zeros_of_tables,
)
from jaxbundle.leastsquares.equations.elimination import (
    Incident,
    NormalFactor,
    solve,
    sum_over_pairs,
)
from jaxbundle.leastsquares.equations.reduced import Reduced
from jaxbundle.leastsquares.indexing.plan import IncidencePairs, Plan, Tangent
from jaxbundle.leastsquares.indexing.rows import Declared, Values
from jaxbundle.types import not_none


class Cofactors(eqx.Module):
    """Blocks of Q = N⁻¹.

    `diagonal_blocks`: of every row of every group, in the datum of the problem. The others are for
    residuals, in the regularised datum of the factor (use them for estimable quantities only):
    `kept`, the blocks of the reduced system; `eliminated`; `coupled`, every eliminated row with the
    kept row of its incidences; `lower_inverse`, L⁻¹ of the eliminated rows. Held unknowns have
    zeros.
    """

    diagonal_blocks: dict[str, Float[Array, "rows w w"]]
    kept: Reduced
    eliminated: Float[Array, "rows w w"] | None
    coupled: dict[str, Float[Array, "chunks length w v"]]
    lower_inverse: Float[Array, "rows w w"] | None


def cofactors(
    declared: Declared, values: Values, factor: NormalFactor, moves: Tangent | None = None
) -> Cofactors:
    """All cofactor blocks of a solved problem; `moves`: the generators, if known."""
    plan = factor.plan
    # Takahashi's blocks, or all of them where S is dense; the full Q of eliminated rows (3 × 22 106
    # on BAL 16) is never formed.
    Q = factor.inverse()
    # Held unknowns had ones in S.
    mask = lambda B, g: B * plan.groups[g].free[:, :, None] * plan.groups[g].free[:, None, :]
    Q = Reduced({g: mask(B, g) for g, B in Q.diagonal_blocks.items()}, Q.off_diagonal_blocks)
    eliminated, coupled = None, {}
    diagonal = dict(Q.diagonal_blocks)
    if plan.eliminated is not None:
        K, L = _couplings(factor, Q), not_none(factor.lower_inverse)
        # L⁻ᵀ·(1 + K·Zᵀ)·L⁻¹: V⁻¹, and what the uncertainty of the kept rows adds.
        inner = jnp.broadcast_to(jnp.eye(L.shape[1]), L.shape)
        for g, k in K.items():
            at = plan.incidences[g].eliminated.ravel()
            rows = jnp.einsum("clij,clkj->clik", k, factor.Z[g]).reshape(-1, *L.shape[1:])
            inner = inner + jax.ops.segment_sum(rows, at, L.shape[0])
            coupled[g] = -jnp.einsum("clji,cljk->clik", L[plan.incidences[g].eliminated], k)
        free = plan.groups[plan.eliminated].free
        eliminated = jnp.einsum("nji,njk,nkl->nil", L, inner, L)
        eliminated = eliminated * free[:, :, None] * free[:, None, :]
        diagonal[plan.eliminated] = eliminated
    diagonal = _in_datum(declared, values, factor, diagonal, moves)
    return Cofactors(diagonal, Q, eliminated, coupled, factor.lower_inverse)


def _couplings(factor: NormalFactor, Q: Reduced) -> Incident:
    """K of every incidence."""
    plan, Z = factor.plan, factor.Z
    K = {
        g: jnp.einsum("clij,cjk->clik", z, Q.diagonal_blocks[g][plan.incidences[g].row])
        for g, z in Z.items()
    }
    flat = {g: k.reshape(-1, *k.shape[2:]) for g, k in K.items()}
    rows = {g: z.reshape(-1, *z.shape[2:]) for g, z in Z.items()}
    for (later, earlier), block in plan.blocks.items():
        if block.pairs is None:
            continue
        flat[later], flat[earlier] = _add_over_pairs(
            block.pairs,
            rows[later],
            rows[earlier],
            Q.off_diagonal_blocks[later, earlier],
            flat[later],
            flat[earlier],
            later == earlier,
        )
    return {g: flat[g].reshape(k.shape) for g, k in K.items()}


def _add_over_pairs(
    pairs: IncidencePairs,
    a: Float[Array, "places e w"],
    b: Float[Array, "places e v"],
    Q: Float[Array, "blocks w v"],
    to_first: Float[Array, "places e w"],
    to_second: Float[Array, "places e v"],
    within: bool,
) -> tuple[Float[Array, "places e w"], Float[Array, "places e v"]]:
    """Add b·Qᵀ to the first total for every partner b of its row, and a·Q to the second; Q is the
    block of each pair. `within`: the two totals are the same."""
    totals = (to_first,) if within else (to_first, to_second)

    def add(
        totals: tuple[Array, ...],
        i: Int[Array, "chunks length"],
        j: Int[Array, "chunks length"],
        k: Int[Array, " chunks"],
    ) -> tuple[Array, ...]:
        # Both incidences of a pair get the other's share: K_i gains Z_j·Qᵀ, K_j Z_i·Q.
        to_second = jnp.einsum("clij,cjk->clik", a[i], Q[k])
        to_first = jnp.einsum("clij,ckj->clik", b[j], Q[k])
        if within:
            return (totals[0].at[i].add(to_first).at[j].add(to_second),)
        return totals[0].at[i].add(to_first), totals[1].at[j].add(to_second)

    totals = sum_over_pairs(pairs, add, totals)
    # The row that represents nothing has accumulated the padding of chunks.
    return totals[0], totals[0 if within else 1]


def _in_datum(
    declared: Declared,
    values: Values,
    factor: NormalFactor,
    diagonal: Tangent,
    moves: Tangent | None,
) -> Tangent:
    """The diagonal blocks in the datum of the problem: S·Q·Sᵀ."""
    plan = factor.plan
    if plan.datum is None:
        return diagonal
    # S·Q·Sᵀ = Q − G·(M·BᵀQ) − (Q·B·Mᵀ)·Gᵀ + G·M·BᵀQB·Mᵀ·Gᵀ, M = (BᵀG)⁻¹: d solutions with the
    # factor instead of the whole Q.
    G, B = datum_directions(declared, plan, values, moves)
    H = jax.vmap(lambda b: solve(factor, b), -1, -1)(B)
    M = jnp.linalg.inv(contract(plan, B, G))
    A = {g: h @ M.T for g, h in H.items()}
    C = M @ contract(plan, B, A)

    def project(
        Q: Float[Array, "rows w w"],
        g: Float[Array, "rows w defect"],
        a: Float[Array, "rows w defect"],
    ) -> Float[Array, "rows w w"]:
        cross = jnp.einsum("nik,njk->nij", g, a)
        return Q - cross - cross.transpose(0, 2, 1) + jnp.einsum("nik,kl,njl->nij", g, C, g)

    return {name: project(Q, G[name], A[name]) for name, Q in diagonal.items()}


def blocks_of_tables(
    declared: Declared, plan: Plan, diagonal: Tangent, values: Values
) -> dict[str, Float[Array, "rows width width"]]:
    """`Cofactors.diagonal_blocks` by table rows; zero for held unknowns."""
    empty = zeros_of_tables(declared, values)
    blocks = {name: jnp.zeros((*zero.shape, zero.shape[1])) for name, zero in empty.items()}
    for name, group in plan.groups.items():
        for m in group.members:
            columns, rows = (
                slice(m.start, m.start + m.width),
                slice(None) if m.rows is None else m.rows,
            )
            blocks[m.table] = blocks[m.table].at[rows].add(diagonal[name][:, columns, columns])
    return blocks


def propagate(
    declared: Declared,
    values: Values,
    factor: NormalFactor,
    rows: Tangent,
    moves: Tangent | None = None,
) -> Float[Array, "f f"]:
    """F·Q·Fᵀ in the datum for any linear functions F of the unknowns (first axis of `rows`): one
    structured solve per function."""
    plan = factor.plan
    from_datum = jax.vmap(lambda r: s_transform_transposed(declared, plan, values, r, moves))(rows)
    solved = jax.vmap(lambda r: solve(factor, r))(from_datum)
    products = (jnp.einsum("fni,gni->fg", from_datum[g], solved[g]) for g in from_datum)
    return sum(products, jnp.zeros(()))
