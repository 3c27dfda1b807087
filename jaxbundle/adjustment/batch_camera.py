"""Levenberg–Marquardt for one camera calibrated from many views of known points.

Damping is Marquardt's (1963), λ·diag(N); λ follows Nielsen (1999). Near the minimum it is dropped:
the last steps are Gauss–Newton's. A camera has converged when the undamped step promises to move
no unknown by more than `TOLERANCE` of its standard deviation, d² = δᵀNδ ≤ (`TOLERANCE`·σ₀)²
(compare `solver.py`); that step is still taken. Where the damped steps have settled and the
undamped one cannot be computed, or is rounding, the camera is singular.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxbundle.adjustment.batch_normal import (
    POSE,
    Calibration,
    Sightings,
    cofactors,
    factorise,
    normal_equations,
    retract,
    step,
)

STATUS = (
    "converged", "iteration limit", "singular", "not finite", "too few points", "weak", "misfit"
)  # fmt: skip
CONVERGED, LIMIT, SINGULAR, NOT_FINITE, TOO_FEW, WEAK, MISFIT = range(7)
RUNNING = -1

TOLERANCE = 1e-5
FIRST_DAMPING, LEAST_DAMPING = 1e-3, 1e-14
NEAR = 1e-2
"""Near the minimum: the last step promised to decrease vᵀv by less than this fraction."""
ROUNDING, NOISE_FLOOR = 2e-14, 1e-14
"""Below these a decrease of vᵀv, relative, and a residual, relative to the image, are noise."""
INDETERMINATE = 1e-13
"""A parameter of which so little is left beside all others is determined by rounding: singular.

(5 coefficients: 1e-8 to 1e-4; 8, where 5 are enough: 1e-13 to 1e-11; one view repeated: 1e-15.)
"""
NEARER = 1e-2
"""Each undamped step that was refused, or could not be computed, asks for so much nearer."""


class Solved(eqx.Module):
    """The end of the iterations: unknowns, ½vᵀv, cofactors, the scaled reduced normal matrix, why
    it ended, steps, views used."""

    at: Calibration
    cost: Float[Array, ""]
    interior_cofactors: Float[Array, "k k"]
    pose_cofactors: Float[Array, "views 6 6"]
    reduced: Float[Array, "k k"]
    redundancy: Int[Array, ""]
    views: Bool[Array, " views"]
    status: Int[Array, ""]
    steps: Int[Array, ""]


class _Loop(eqx.Module):
    """What the loop carries: the accepted unknowns with N there, and the next to be tried."""

    at: Calibration
    trial: Calibration
    N: Float[Array, "views n n"]
    cost: Float[Array, ""]
    predicted: Float[Array, ""]
    damping: Float[Array, ""]
    growth: Float[Array, ""]
    near: Bool[Array, ""]
    refusals: Int[Array, ""]
    status: Int[Array, ""]
    steps: Int[Array, ""]


def solve_camera(model, free, max_steps, size, seen: Sightings, start: Calibration) -> Solved:
    """Calibrate one camera from its start values.

    **Arguments:** `free`: columns of the free parameters; `size`: a length of the image, pixels.
    """
    views = seen.views
    rows = 2 * jnp.sum(seen.weight > 0)
    redundancy = rows - len(free) - POSE * jnp.sum(views)
    floor = rows * (NOISE_FLOOR * size) ** 2

    def body(loop: _Loop) -> _Loop:
        N = normal_equations(model, free, seen, loop.trial)
        cost = 0.5 * jnp.sum(N[:, -1, -1])
        first, finite = loop.steps == 0, jnp.all(jnp.isfinite(N))
        ratio = (loop.cost - cost) / loop.predicted
        accept = finite & (first | (ratio > 1e-3))
        choose = lambda new, old: jax.tree.map(lambda a, b: jnp.where(accept, a, b), new, old)
        at, N, cost = choose((loop.trial, N, cost), (loop.at, loop.N, loop.cost))

        wider = loop.damping * jnp.maximum(1 / 10, 1 - (2 * ratio - 1) ** 3)
        damping = jnp.where(accept, wider, loop.damping * loop.growth)
        damping = jnp.where(first, FIRST_DAMPING, jnp.maximum(damping, LEAST_DAMPING))
        growth = jnp.where(accept, 2.0, 2.0 * loop.growth)
        refusals = loop.refusals + (loop.near & ~accept)
        near = accept & ~first & (loop.predicted < NEAR * NEARER**refusals * cost)
        near |= accept & (cost <= floor)

        used = jnp.where(near, 0.0, damping)
        factor = factorise(N, views, used)
        d_pose, d_interior = step(factor)
        # −gᵀδ and δᵀDδ
        g_pose, g_interior = N[:, :POSE, -1], N[:, POSE:-1, -1].sum(0)
        slope = -jnp.sum(g_pose * d_pose) - jnp.vdot(g_interior, d_interior)
        D = jnp.diagonal(N, axis1=1, axis2=2)
        damped = jnp.sum(D[:, :POSE] * d_pose**2)
        damped += jnp.vdot(D[:, POSE:-1].sum(0), d_interior**2)

        variance = 2 * cost / jnp.maximum(redundancy, 1)
        small = jnp.maximum(TOLERANCE**2 * variance, jnp.maximum(2 * ROUNDING * cost, floor))
        solvable = jnp.isfinite(slope)
        status = jnp.where(loop.steps + 1 >= max_steps, LIMIT, RUNNING)
        status = jnp.where(near & solvable & (slope <= small), CONVERGED, status)
        unsolved = near & ~solvable
        settled = (loop.predicted <= small) & ~first
        status = jnp.where(unsolved & settled, SINGULAR, status)
        status = jnp.where(first & ~finite, NOT_FINITE, status)
        return _Loop(
            at=at, trial=retract(free, at, d_pose, d_interior), N=N, cost=cost,
            predicted=jnp.where(unsolved, jnp.nan, 0.5 * (slope + used * damped)),
            damping=damping, growth=growth, near=near,
            refusals=refusals, status=status, steps=loop.steps + 1,
        )  # fmt: skip

    few = (redundancy < 1) | ~jnp.any(views)
    n, zero = POSE + len(free) + 1, jnp.asarray(0.0)
    loop = jax.lax.while_loop(
        lambda loop: loop.status == RUNNING,
        body,
        _Loop(
            at=start, trial=start, N=jnp.zeros((len(views), n, n)), cost=zero,
            predicted=zero, damping=zero + FIRST_DAMPING, growth=zero + 2,
            near=jnp.asarray(False), refusals=jnp.asarray(0),
            status=jnp.where(few, TOO_FEW, RUNNING), steps=jnp.asarray(0),
        ),
    )  # fmt: skip
    factor = factorise(loop.N, views, 0.0)
    Q_interior, Q_pose, weakest = cofactors(factor)
    lost = (loop.status == CONVERGED) & ~(weakest > INDETERMINATE)
    status = jnp.where(lost, SINGULAR, loop.status)
    return Solved(
        loop.trial, loop.cost, Q_interior, Q_pose, factor.reduced, redundancy, views, status,
        loop.steps,
    )  # fmt: skip
