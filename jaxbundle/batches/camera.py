"""Levenberg–Marquardt for one camera calibrated from many views of known points.

The steps, their acceptance and the end of the iterations are the engine's
(`leastsquares/iterations/loop.py`, `stopping.py`). Only the layout of the normal equations is its
own (`normal.py`), because a batch has thousands of such small problems: the engine declares tables
and observations, sorts them and compiles a program for each size, which pays for one large problem;
here all cameras of a shape, [views, points], share one program without any index. Measured in one
process, with one thread, for 20 views × 88 points: 2.6 ms from nothing to σ and poses, in seven
iterations; the engine takes 11 ms to evaluate a network that is at its minimum already, and
`adjust` with the statistics of the network 50 ms. (`benchmarks/calibration.py`: 0.94 ms a camera
with all cores of a quiet machine.)

Anything that does not fit the layout, such as rigs, priors, or a rolling shutter, goes through the
engine (`rigs`).
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxbundle.batches.normal import (
    POSE,
    CameraUnknowns,
    Sightings,
    cofactors,
    factorise,
    normal_equations,
    retract,
    step,
)
from jaxbundle.cameras import CameraModel
from jaxbundle.leastsquares.iterations import stopping
from jaxbundle.leastsquares.iterations.loop import iterate
from jaxbundle.leastsquares.iterations.stopping import Tolerance

STATUS = (
    "converged",
    "iteration limit",
    "singular",
    "not finite",
    "too few points",
    "weak",
    "misfit",
)
CONVERGED, LIMIT, SINGULAR, NOT_FINITE, TOO_FEW, WEAK, MISFIT = range(7)
# Statuses of cameras that have values.
SOLVED = (STATUS[CONVERGED], STATUS[WEAK], STATUS[MISFIT])
# The status of a camera by termination.
MEANING = {
    stopping.LIMIT: LIMIT,
    stopping.SETTLED: CONVERGED,
    stopping.RELATIVE_COST: CONVERGED,
    stopping.SINGULAR: SINGULAR,
    stopping.STUCK: LIMIT,
    stopping.NOT_FINITE: NOT_FINITE,
}

# Smallest part of a parameter that is independent of the others; below it rounding: singular.
#
# Measured: 5 coefficients 1e-8 to 1e-4; 8, where 5 are enough, 1e-13 to 1e-11; one view repeated
# 1e-15.
INDETERMINATE = 1e-13


class CameraSolution(eqx.Module):
    """The end of the iterations: unknowns, ½vᵀv, cofactors, the scaled reduced normal matrix,
    redundancy, views used, the index of the status in `STATUS`, number of evaluations."""

    unknowns: CameraUnknowns
    cost: Float[Array, ""]
    interior_cofactors: Float[Array, "k k"]
    pose_cofactors: Float[Array, "views 6 6"]
    reduced: Float[Array, "k k"]
    redundancy: Int[Array, ""]
    views: Bool[Array, " views"]
    status: Int[Array, ""]
    steps: Int[Array, ""]


def solve_camera(
    model: CameraModel,
    free: tuple[int, ...],
    max_steps: int,
    size: float,
    sightings: Sightings,
    start: CameraUnknowns,
) -> CameraSolution:
    """Calibrate one camera from its start values.

    **Arguments:** `free`: columns of the free parameters; `size`: a length of the image, pixels.
    """
    views = sightings.views
    rows = 2 * jnp.sum(sightings.weight > 0)
    redundancy = rows - len(free) - POSE * jnp.sum(views)
    zero = jnp.asarray(0.0)
    # Ends where no unknown would move by more than 1e-5 of its σ: the printed digits do not depend
    # on the start, and as convergence is quadratic, this costs a step at most. `size` stands for
    # each measured coordinate, of whose rounding the arithmetic noise of residuals is a multiple.
    tolerance = Tolerance(redundancy, rows * size**2, zero + 1e-5, zero)

    def linearise(unknowns: CameraUnknowns) -> tuple[Float[Array, "views n n"], Float[Array, ""]]:
        N = normal_equations(model, free, sightings, unknowns)
        return N, jnp.where(jnp.all(jnp.isfinite(N)), 0.5 * jnp.sum(N[:, -1, -1]), jnp.nan)

    # Stopped before the first step: without redundancy the residuals vanish whatever the camera.
    has_too_few = (redundancy < 1) | ~jnp.any(views)
    loop = iterate(
        linearise,
        lambda N, damping: _change(N, views, damping),
        lambda unknowns, d: retract(free, unknowns, *d),
        start,
        lambda _: tolerance,
        max_steps,
        ~has_too_few,
    )
    # Undamped: damping would make singular equations look determined.
    factor = factorise(loop.equations, views, 0.0)
    Q_interior, Q_pose, weakest = cofactors(factor)
    meaning = jnp.array([MEANING[code] for code in range(len(MEANING))])
    status = jnp.where(has_too_few, TOO_FEW, meaning[loop.termination])
    is_indeterminate = (status == CONVERGED) & ~(weakest > INDETERMINATE)
    # A settled step is taken without being tried, as by the engine; another may yet be rejected.
    settled = loop.termination == stopping.SETTLED
    return CameraSolution(
        jax.tree.map(
            lambda trial_leaf, accepted_leaf: jnp.where(settled, trial_leaf, accepted_leaf),
            loop.trial,
            loop.at,
        ),
        loop.cost,
        Q_interior,
        Q_pose,
        factor.reduced,
        redundancy,
        views,
        jnp.where(is_indeterminate, SINGULAR, status),
        loop.steps,
    )


def _change(
    N: Float[Array, "views n n"], views: Bool[Array, " views"], damping: Float[Array, ""]
) -> tuple[tuple[Array, Array], Float[Array, ""], Float[Array, ""]]:
    """The damped step δ, −gᵀδ and δᵀDδ: the linear model decreases by ½·(−gᵀδ + λ·δᵀDδ)."""
    d_pose, d_interior = step(factorise(N, views, damping))
    g_pose, g_interior = N[:, :POSE, -1], N[:, POSE:-1, -1].sum(0)
    decrement = -jnp.sum(g_pose * d_pose) - jnp.vdot(g_interior, d_interior)
    D = jnp.diagonal(N, axis1=1, axis2=2)
    damped = jnp.sum(D[:, :POSE] * d_pose**2)
    damped += jnp.vdot(D[:, POSE:-1].sum(0), d_interior**2)
    return (d_pose, d_interior), decrement, damped
