"""Reliability of the observations: redundancy numbers, blunder tests, undetectable errors.

For the observations of one row, with covariance C = L·Lᵀ, weight P = C⁻¹, residuals v and their
cofactors Q_vv = C − J·Q·Jᵀ, and eᵢ the unit vector of one residual (Baarda 1968; Förstner 1985):

    rᵢ  = (Q_vv·P)ᵢᵢ                       redundancy number, Σr = redundancy
    w   = (P·v)ᵢ/√(P·Q_vv·P)ᵢᵢ             Baarda's test, standard normal without a blunder
    τ   = w/σ̂0                            Pope's test (1976), σ a posteriori
    MDB = δ0/√(P·Q_vv·P)ᵢᵢ                 smallest blunder found with the chosen power
    δ̄   = δ0·√(h/(1 − h))                  its largest effect on any unknown, in units of that σ

Computed with whitened residuals u = L⁻¹·v and B = L⁻¹·J·Q·Jᵀ·L⁻ᵀ. An error of residual i points
along n = L⁻¹·eᵢ/|L⁻¹·eᵢ|, so that w = nᵀu/√(1 − h) with h = nᵀ·B·n. For uncorrelated observations
(n = eᵢ, B diagonal elements alone) this is r = 1 − h, w = (v/σ)/√r and MDB = σ·δ0/√r: r is in
[0, 1] from uncontrolled to fully controlled, which does not hold for correlated ones.
"""

from collections.abc import Iterable, Mapping
from dataclasses import fields
from functools import partial
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxbundle.leastsquares.equations.linearise import differentiate_chunks
from jaxbundle.leastsquares.indexing.plan import ObservationPart, Plan
from jaxbundle.leastsquares.indexing.rows import (
    ChunkedData,
    Data,
    Declared,
    Values,
    diagonal_of,
    lay_out_data,
    prepare,
    restore_order,
)
from jaxbundle.leastsquares.quality.cofactors import Cofactors
from jaxbundle.system.programs import compile_once
from jaxbundle.types import AnyArray, not_none

# Redundancy numbers below this are rounding: the observation is uncontrolled. 1 − h of a number h
# near 1 has an error of 1e-16 times the condition of N, 1e4 to 1e6 in common networks; above it w
# is right to some per cent, and the smallest detectable blunder is 4e4 σ.
MIN_REDUNDANCY = 1e-8


class Reliability(eqx.Module):
    """By set of observations, [n, r], 0 for residuals without weight: `residual`, v/σ; `standard`,
    nᵀu (v/σ if uncorrelated); `gain`, σ·√Pᵢᵢ ≥ 1 (1 if uncorrelated), by which the other residuals
    of its row sharpen it; the redundancy number; Baarda's w (NaN if uncontrolled); the leverage
    `hat`, h; and `eliminated_leverage`, its part due to the eliminated row of the observation
    alone. `joint` [n, 1], of two uncorrelated residuals: B between them, which deletes both
    together; else [n, 0]."""

    residual: Mapping[str, Float[AnyArray, "n r"]]
    standard: Mapping[str, Float[AnyArray, "n r"]]
    gain: Mapping[str, Float[AnyArray, "n r"]]
    redundancy: Mapping[str, Float[AnyArray, "n r"]]
    w: Mapping[str, Float[AnyArray, "n r"]]
    hat: Mapping[str, Float[AnyArray, "n r"]]
    eliminated_leverage: Mapping[str, Float[AnyArray, "n r"]]
    joint: Mapping[str, Float[AnyArray, "n c"]]


@compile_once
def reliability(
    declared: Declared, plan: Plan, values: Values, data: Data, Q: Cofactors
) -> Reliability:
    """Redundancy numbers and test statistics of all observations."""
    chunked = lay_out_data(plan, data)
    by_part = hat_blocks(declared, plan, values, chunked, Q)
    whitened, hats, eliminated_leverages = (restore_order(plan, rows) for rows in by_part)
    by_set = {
        o: _correlated(data.weight[o], u, hats[o], eliminated_leverages[o])
        if data.weight[o].ndim == 3
        else _uncorrelated(data.weight[o], u, hats[o], eliminated_leverages[o])
        for o, u in whitened.items()
    }
    columns = {f.name: {o: x[f.name] for o, x in by_set.items()} for f in fields(Reliability)}
    return Reliability(**columns)


def _uncorrelated(
    weight: Float[AnyArray, "n r"],
    v: Float[Array, "n r"],
    hat: Float[Array, "n rc"],
    eliminated_leverage: Float[Array, "n rc"],
) -> dict[str, Float[AnyArray, "n r"]]:
    has_weight, r = weight > 0, v.shape[-1]
    hat, joint, eliminated_leverage = hat[:, :r], hat[:, r:], eliminated_leverage[:, :r]
    return {
        "residual": v,
        "standard": v,
        "gain": has_weight.astype(float),
        "redundancy": jnp.where(has_weight, jnp.clip(1 - hat, 0.0, 1.0), 0.0),
        "w": _test(v, hat, has_weight),
        "hat": hat,
        "eliminated_leverage": eliminated_leverage,
        "joint": joint,
    }


def _correlated(
    weight: Float[AnyArray, "n r r"],
    u: Float[Array, "n r"],
    hat: Float[Array, "n r r"],
    eliminated_leverage: Float[Array, "n r r"],
) -> dict[str, Float[AnyArray, "n r"]]:
    """Of whitening matrices L⁻¹ [n, r, r] and blocks B of the same shape."""
    has_weight = diagonal_of(weight) > 0
    L = _invert_lower(jnp.where(has_weight[..., None], weight, jnp.eye(weight.shape[-1])))
    sigma = jnp.sqrt((L**2).sum(2))
    length = jnp.sqrt((weight**2).sum(1))  # √Pᵢᵢ
    n = weight / jnp.where(has_weight, length, 1.0)[:, None, :]
    along_normals = lambda B: jnp.einsum("nki,nkl,nli->ni", n, B, n)
    h, standard = along_normals(hat), jnp.einsum("nki,nk->ni", n, u)
    r = jnp.einsum("nik,nkl,nli->ni", L, jnp.eye(weight.shape[-1]) - hat, weight)
    return {
        "residual": jnp.einsum("nik,nk->ni", L, u) / sigma,
        "standard": standard,
        "gain": jnp.where(has_weight, sigma * length, 0.0),
        "redundancy": jnp.where(has_weight, r, 0.0),
        "w": _test(standard, h, has_weight),
        "hat": h,
        "eliminated_leverage": along_normals(eliminated_leverage),
        "joint": jnp.zeros((len(u), 0)),
    }


def _test(
    standard: Float[Array, "n r"], hat: Float[Array, "n r"], has_weight: Bool[AnyArray, "n r"]
) -> Float[Array, "n r"]:
    controlled = has_weight & (1 - hat > MIN_REDUNDANCY)
    return jnp.where(controlled, standard / jnp.sqrt(jnp.where(controlled, 1 - hat, 1.0)), jnp.nan)


def _invert_lower(W: Float[AnyArray, "n r r"]) -> Float[AnyArray, "n r r"]:
    """W⁻¹ of lower triangular matrices, by forward substitution."""
    size, rows = W.shape[-1], []
    for i in range(size):
        right = jnp.broadcast_to(jnp.eye(size)[i], W[:, i].shape)
        for k, row in enumerate(rows):
            right = right - W[:, i, k, None] * row
        rows.append(right / W[:, i, i, None])
    return jnp.stack(rows, 1)


def hat_blocks(
    declared: Declared, plan: Plan, values: Values, chunked: ChunkedData, Q: Cofactors
) -> Iterable[tuple[Array, ...]]:
    """Of every part, from the blocks of Q that each observation touches: whitened residuals
    [chunks, length, r], B, and its part E·V⁻¹·Eᵀ of the eliminated row alone; of B the diagonal
    and, of two residuals, the element between them, [chunks, length, r or 3], or for correlated
    observations all of it, [chunks, length, r, r]."""
    prepared = prepare(declared, values)
    blocks = []
    for number in range(len(plan.parts)):
        correlated = isinstance(chunked.weight[number][0], tuple)
        of_chunk = partial(_hat_of_chunk, Q, correlated)
        blocks.append(differentiate_chunks(declared, plan, number, prepared, chunked, of_chunk))
    return zip(*blocks) if blocks else ((), (), ())


def _hat_of_chunk(
    Q: Cofactors,
    correlated: bool,
    part: ObservationPart,
    r: Float[Array, "length r"],
    touches: tuple[Float[Array, "length r w"], ...],
    E: Float[Array, "length r e"] | None,
) -> tuple[Array, Array, Array]:
    """`hat_blocks` of one chunk, [length, …]."""
    block = lambda a, b: jnp.einsum("lic,ljc->lij", a, b)
    form = block if correlated else _diagonal_and_joint
    rows = r.shape[-1]
    inner = (rows, rows) if correlated else (rows + (rows == 2),)
    hat = eliminated_leverage = jnp.zeros((*r.shape[:-1], *inner))
    if touches:
        J = jnp.concatenate(touches, -1)
        # h = J·Q·Jᵀ from the blocks of Q that the observation touches, 9 × 9 and 3 × 3: kept,
        # eliminated, and the coupling of both.
        hat = form(J @ _kept_cofactors(part, Q), J)
    if E is not None:
        # E·V⁻¹·Eᵀ: h if everything else were known.
        root = jnp.einsum("lri,lji->lrj", E, not_none(Q.lower_inverse)[part.eliminated])
        eliminated_leverage = form(root, root)
        hat = hat + form(E @ not_none(Q.eliminated)[part.eliminated], E)
        for touch, J in zip(part.touches, touches):
            coupled = Q.coupled[touch.group]
            of_row = coupled.reshape(-1, *coupled.shape[2:])[touch.incidence]
            cross = form(E @ of_row[..., touch.start : touch.stop], J)
            hat = hat + cross + (cross.mT if correlated else cross)
    return r, hat, eliminated_leverage


def _diagonal_and_joint(
    a: Float[Array, "length r w"], b: Float[Array, "length r w"]
) -> Float[Array, "length rc"]:
    """The diagonal of a·bᵀ; of two rows also the element between them of its symmetric part."""
    diagonal = jnp.sum(a * b, -1)
    if a.shape[1] != 2:
        return diagonal
    joint = jnp.sum(a[:, 0] * b[:, 1] + a[:, 1] * b[:, 0], -1, keepdims=True) / 2
    return jnp.concatenate([diagonal, joint], -1)


def _kept_cofactors(part: ObservationPart, Q: Cofactors) -> Float[Array, "n n"]:
    """The block of Q of all kept rows that a chunk touches, in the order of its touches."""
    touches = part.touches
    sub_block = lambda B, rows, columns: B[rows.start : rows.stop, columns.start : columns.stop]
    blocks: list[list[Any]] = [[None] * len(touches) for _ in touches]
    for t, touch in enumerate(touches):
        blocks[t][t] = sub_block(Q.kept.diagonal_blocks[touch.group][touch.row], touch, touch)
    for coupling in part.couplings:
        first, second = touches[coupling.first], touches[coupling.second]
        block: Any = 0.0
        if coupling.block is not None:
            # Stored below the diagonal; `turned` where this chunk has the later row second.
            B = Q.kept.off_diagonal_blocks[first.group, second.group][coupling.block]
            block = sub_block(B, first, second)
            if coupling.turned is not None:
                block = jnp.where(coupling.turned > 0, sub_block(B, second, first).T, block)
        if coupling.same is not None:
            diagonal_block = sub_block(
                Q.kept.diagonal_blocks[first.group][first.row], first, second
            )
            block = jnp.where(coupling.same > 0, diagonal_block, block)
        blocks[coupling.first][coupling.second] = block
        blocks[coupling.second][coupling.first] = block.T
    return jnp.block(blocks)


def minimal_detectable(
    sigma: Float[AnyArray, "..."], redundancy: Float[AnyArray, "..."], delta0: float = 4.13
) -> Float[np.ndarray, "..."]:
    """Smallest blunder found by the w-test, in the unit of σ (δ0 = 4.13: α 0.1 %, power 80 %); for
    correlated observations with σ/`gain` and 1 − `hat` of their `Reliability`."""
    r = np.asarray(redundancy)
    return np.where(
        r > MIN_REDUNDANCY,
        np.asarray(sigma) * delta0 / np.sqrt(np.maximum(r, MIN_REDUNDANCY)),
        np.inf,
    )


def external_reliability(
    redundancy: Float[AnyArray, "..."], delta0: float = 4.13
) -> Float[np.ndarray, "..."]:
    """Largest effect of an undetected blunder on any unknown, in units of that unknown's σ; for
    correlated observations with 1 − `hat` of their `Reliability`."""
    r = np.asarray(redundancy)
    bounded = np.maximum(r, MIN_REDUNDANCY)
    return np.where(r > MIN_REDUNDANCY, delta0 * np.sqrt((1 - bounded) / bounded), np.inf)
