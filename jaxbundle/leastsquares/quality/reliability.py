"""Reliability of the observations: redundancy numbers, blunder tests, undetectable errors.

With the residuals divided by their a priori σ (v/σ) and h = diag(J·Q·Jᵀ) (Baarda 1968; Förstner
1985):

    r   = 1 − h                     redundancy number, 0 (uncontrolled) to 1; Σr = redundancy
    w   = (v/σ)/√r                  Baarda's test, standard normal without a blunder (σ a priori)
    τ   = w/σ̂0                      Pope's test (1976), σ a posteriori
    MDB = σ·δ0/√r                   smallest blunder found with the chosen power
    δ̄   = δ0·√((1 − r)/r)           its largest effect on any unknown, in units of that σ

For observations with a covariance, v/σ means L⁻¹·v.
"""

from collections.abc import Mapping
from functools import partial
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxbundle.leastsquares.equations.linearise import differentiate_chunks
from jaxbundle.leastsquares.indexing.plan import Part, Plan
from jaxbundle.leastsquares.indexing.rows import (
    Data,
    Declared,
    Laid,
    Values,
    diagonal_of,
    lay_out_data,
    prepare,
    restore_order,
)
from jaxbundle.leastsquares.quality.cofactors import Cofactors
from jaxbundle.system.programs import compile_once
from jaxbundle.types import AnyArray, present

UNCONTROLLED = 1e-8
"""Redundancy numbers below this are rounding: the observation is uncontrolled."""


class Reliability(eqx.Module):
    """By set of observations, [n, r]: v/σ, redundancy number, Baarda's w (NaN if r is zero), `hat`
    h = 1 − r, and its part due to the eliminated row of the observation alone."""

    residual: Mapping[int, Float[AnyArray, "n r"]]
    redundancy: Mapping[int, Float[AnyArray, "n r"]]
    w: Mapping[int, Float[AnyArray, "n r"]]
    hat: Mapping[int, Float[AnyArray, "n r"]]
    own: Mapping[int, Float[AnyArray, "n r"]]


@compile_once
def reliability(
    declared: Declared, plan: Plan, values: Values, data: Data, Q: Cofactors
) -> Reliability:
    """Redundancy numbers and test statistics of all observations."""
    laid = lay_out_data(plan, data)
    found = hat_diagonal(declared, plan, values, laid, Q)
    residual, hat, own = (restore_order(plan, rows) for rows in found)
    number = lambda h, weight: jnp.where(weight > 0, jnp.clip(1.0 - h, 0.0, 1.0), 0.0)
    r = {o: number(h, diagonal_of(data.weight[o])) for o, h in hat.items()}
    test = lambda v, r: jnp.where(r > UNCONTROLLED, v / jnp.sqrt(jnp.maximum(r, 1e-300)), jnp.nan)
    return Reliability(residual, r, {o: test(residual[o], r[o]) for o in r}, hat, own)


def hat_diagonal(declared: Declared, plan: Plan, values: Values, laid: Laid, Q: Cofactors):
    """v/σ, h = diag(J·Q·Jᵀ) and its part E·V⁻¹·Eᵀ of the eliminated row alone, of every part,
    [chunks, length, r], from the blocks of Q that each observation touches."""
    prepared, of_chunk = prepare(declared, values), partial(_of_chunk, Q)
    found = [
        differentiate_chunks(declared, plan, number, prepared, laid, of_chunk)
        for number in range(len(plan.parts))
    ]
    return zip(*found) if found else ((), (), ())


def _of_chunk(Q: Cofactors, part: Part, r, touches, E):
    """The same of one chunk, [length, r]."""
    form = lambda a, B, b: jnp.sum((a @ B) * b, -1)
    hat = own = jnp.zeros_like(r)
    if touches:
        J = jnp.concatenate(touches, -1)
        hat = form(J, _of_kept(part, Q), J)
    if E is not None:
        own = jnp.einsum("lri,lji->lrj", E, present(Q.lower_inverse)[part.eliminated])
        own = jnp.sum(own**2, -1)
        hat = hat + form(E, present(Q.eliminated)[part.eliminated], E)
        for touch, J in zip(part.touches, touches):
            coupled = Q.coupled[touch.group]
            rows = coupled.reshape(-1, *coupled.shape[2:])[touch.incidence]
            hat = hat + 2 * form(E, rows[..., touch.start : touch.stop], J)
    return r, hat, own


def _of_kept(part: Part, Q: Cofactors):
    """The block of Q of all kept rows that a chunk touches, in the order of its touches."""
    touches = part.touches
    cut = lambda B, rows, columns: B[rows.start : rows.stop, columns.start : columns.stop]
    blocks: list[list[Any]] = [[None] * len(touches) for _ in touches]
    for t, touch in enumerate(touches):
        blocks[t][t] = cut(Q.kept.own[touch.group][touch.row], touch, touch)
    for couple in part.couples:
        first, second = touches[couple.first], touches[couple.second]
        found: Any = 0.0
        if couple.block is not None:
            B = Q.kept.off[first.group, second.group][couple.block]
            found = cut(B, first, second)
            if couple.turned is not None:
                found = jnp.where(couple.turned > 0, cut(B, second, first).T, found)
        if couple.same is not None:
            on = cut(Q.kept.own[first.group][first.row], first, second)
            found = jnp.where(couple.same > 0, on, found)
        blocks[couple.first][couple.second] = found
        blocks[couple.second][couple.first] = found.T
    return jnp.block(blocks)


def minimal_detectable(sigma, redundancy, delta0: float = 4.13) -> Float[np.ndarray, "..."]:
    """Smallest blunder found by the w-test, in the unit of σ (δ0 = 4.13: α 0.1 %, power 80 %)."""
    r = np.asarray(redundancy)
    return np.where(
        r > UNCONTROLLED, np.asarray(sigma) * delta0 / np.sqrt(np.maximum(r, UNCONTROLLED)), np.inf
    )


def external_reliability(redundancy, delta0: float = 4.13) -> Float[np.ndarray, "..."]:
    """Largest effect of an undetected blunder on any unknown, in units of that unknown's σ."""
    r = np.asarray(redundancy)
    bounded = np.maximum(r, UNCONTROLLED)
    return np.where(r > UNCONTROLLED, delta0 * np.sqrt((1 - bounded) / bounded), np.inf)
