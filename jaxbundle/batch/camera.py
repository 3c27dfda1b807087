"""Levenberg–Marquardt for one camera calibrated from many views of known points.

The layout of the normal equations is its own (`batch_normal.py`), the rules are the engine's: which
step is accepted and how far the next one may go (`leastsquares/search.py`), when to stop and why
(`leastsquares/stopping.py`).
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxbundle.batch.normal import (
    POSE,
    Calibration,
    Sightings,
    cofactors,
    factorise,
    normal_equations,
    retract,
    step,
)
from jaxbundle.leastsquares import stopping
from jaxbundle.leastsquares.search import RegionState, fraction_kept

STATUS = (
    "converged", "iteration limit", "singular", "not finite", "too few points", "weak", "misfit"
)  # fmt: skip
CONVERGED, LIMIT, SINGULAR, NOT_FINITE, TOO_FEW, WEAK, MISFIT = range(7)
MEANING = {
    stopping.LIMIT: LIMIT, stopping.SETTLED: CONVERGED, stopping.RELATIVE_COST: CONVERGED,
    stopping.SINGULAR: SINGULAR, stopping.STUCK: LIMIT, stopping.NOT_FINITE: NOT_FINITE,
}  # fmt: skip
"""The status of a camera by why its iterations ended."""

TOLERANCE = 1e-5
INDETERMINATE = 1e-13
"""A parameter of which so little is left beside all others is determined by rounding: singular.

(5 coefficients: 1e-8 to 1e-4; 8, where 5 are enough: 1e-13 to 1e-11; one view repeated: 1e-15.)
"""


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
    promised: Float[Array, ""]
    step_size: Float[Array, ""]
    region: RegionState
    approach: stopping.Approach
    termination: Int[Array, ""]
    steps: Int[Array, ""]


def solve_camera(model, free, max_steps, size, seen: Sightings, start: Calibration) -> Solved:
    """Calibrate one camera from its start values.

    **Arguments:** `free`: columns of the free parameters; `size`: a length of the image, pixels.
    """
    views = seen.views
    rows = 2 * jnp.sum(seen.weight > 0)
    redundancy = rows - len(free) - POSE * jnp.sum(views)
    zero = jnp.asarray(0.0)
    tolerance = stopping.Tolerance(redundancy, rows * size**2, zero + TOLERANCE, zero)

    def body(loop: _Loop) -> _Loop:
        first, N = loop.steps == 0, normal_equations(model, free, seen, loop.trial)
        tried = 0.5 * jnp.sum(N[:, -1, -1])
        tried = jnp.where(jnp.all(jnp.isfinite(N)), tried, jnp.nan)
        kept = fraction_kept(loop.promised, loop.cost - tried, tolerance.noise(loop.cost))
        accept, region = loop.region.after(first, kept)
        choose = lambda new, old: jax.tree.map(lambda a, b: jnp.where(accept, a, b), new, old)
        at, N, cost = choose((loop.trial, N, tried), (loop.at, loop.N, loop.cost))
        step_size, approach = loop.approach.choose_step(
            region.radius, loop.step_size, first, accept, loop.promised, kept, cost
        )

        damping = 1 / step_size
        d_pose, d_interior = step(factorise(N, views, damping))
        # −gᵀδ and δᵀDδ
        g_pose, g_interior = N[:, :POSE, -1], N[:, POSE:-1, -1].sum(0)
        decrement = -jnp.sum(g_pose * d_pose) - jnp.vdot(g_interior, d_interior)
        D = jnp.diagonal(N, axis1=1, axis2=2)
        damped = jnp.sum(D[:, :POSE] * d_pose**2)
        damped += jnp.vdot(D[:, POSE:-1].sum(0), d_interior**2)
        finite = jnp.isfinite(decrement)
        d_pose, d_interior = jnp.where(finite, d_pose, 0.0), jnp.where(finite, d_interior, 0.0)

        termination, approach = approach.judge(
            tolerance, step_size, finite, decrement, first, accept, loop.cost, cost, tried
        )
        return _Loop(
            at=at, trial=retract(free, at, d_pose, d_interior), N=N, cost=cost,
            promised=jnp.where(finite, 0.5 * (decrement + damping * damped), 0.0),
            step_size=step_size, region=region, approach=approach, termination=termination,
            steps=loop.steps + 1,
        )  # fmt: skip

    few = (redundancy < 1) | ~jnp.any(views)
    n = POSE + len(free) + 1
    loop = jax.lax.while_loop(
        lambda loop: (loop.termination == stopping.LIMIT) & (loop.steps < max_steps) & ~few,
        body,
        _Loop(
            at=start, trial=start, N=jnp.zeros((len(views), n, n)), cost=zero, promised=zero,
            step_size=jnp.asarray(jnp.inf), region=RegionState.begin(),
            approach=stopping.Approach.begin(), termination=jnp.asarray(stopping.LIMIT),
            steps=jnp.asarray(0),
        ),
    )  # fmt: skip
    factor = factorise(loop.N, views, 0.0)
    Q_interior, Q_pose, weakest = cofactors(factor)
    meaning = jnp.array([MEANING[code] for code in range(len(MEANING))])
    status = jnp.where(few, TOO_FEW, meaning[loop.termination])
    lost = (status == CONVERGED) & ~(weakest > INDETERMINATE)
    return Solved(
        loop.trial, loop.cost, Q_interior, Q_pose, factor.reduced, redundancy, views,
        jnp.where(lost, SINGULAR, status), loop.steps,
    )  # fmt: skip
