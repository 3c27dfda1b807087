"""The iterations of a problem with its own layout of the normal equations.

Acceptance of steps and step sizes follow `search.py`, stopping `stopping.py`; this module only
puts them in order. Everything is traced, so that many problems can be iterated under `vmap` or
`lax.map`.
"""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PyTree

from jaxbundle.leastsquares.iterations.search import (
    TRUST_REGION,
    RegionState,
    gain_ratio,
)
from jaxbundle.leastsquares.iterations.stopping import (
    LIMIT,
    STOPPING,
    StoppingSettings,
    Tolerance,
    UndampedStepState,
)


class Loop(eqx.Module):
    """The accepted unknowns `at`, with the normal equations and ½vᵀPv there; the unknowns to try
    next, and the decrease of ½vᵀPv predicted there; the termination, and the number of
    iterations."""

    at: PyTree
    trial: PyTree
    equations: PyTree
    cost: Float[Array, ""]
    predicted: Float[Array, ""]
    step_size: Float[Array, ""]
    region: RegionState
    undamped_state: UndampedStepState
    termination: Int[Array, ""]
    steps: Int[Array, ""]


def iterate(
    linearise: Callable[[Any], tuple[Any, Any]],
    step: Callable[[Any, Any], tuple[Any, Any, Any]],
    retract: Callable[[Any, Any], Any],
    start: PyTree,
    tolerance: Callable[[Any], Tolerance],
    max_steps: int | Int[Array, ""],
    go: bool | Bool[Array, ""] = True,
    stopping: StoppingSettings = STOPPING,
) -> Loop:
    """Iterate from start values until a stopping criterion is met.

    **Arguments:**

    - `linearise(x)`: the normal equations at x, a tree of arrays, and ½vᵀPv, not finite where it
      cannot be computed.
    - `step(equations, λ)`: the change δ = −(N + λ·D)⁻¹·g, and the numbers −gᵀδ and δᵀ·D·δ.
    - `retract(x, δ)`: applies the change; `tolerance(equations)`: the tolerances.
    - `go`: if false, nothing is done; `stopping`: when the damping is dropped.
    """

    # Traced once, for the shapes of its results and in the loop.
    linearise = jax.jit(linearise)

    def body(loop: Loop) -> Loop:
        # The start is tried in the first pass: the program contains the linearisation once.
        is_first, (trial_equations, trial_cost) = loop.steps == 0, linearise(loop.trial)
        noise = tolerance(loop.equations).noise(loop.cost)
        ratio = gain_ratio(loop.predicted, loop.cost - trial_cost, noise)
        accept, region = loop.region.after(is_first, ratio)
        # N in every pass: under `vmap` a condition would compute both branches, too.
        at, equations, cost = jax.tree.map(
            lambda new, old: jnp.where(accept, new, old),
            (loop.trial, trial_equations, trial_cost),
            (loop.at, loop.equations, loop.cost),
        )
        step_size, undamped_state = loop.undamped_state.choose_step(
            region.radius, loop.step_size, is_first, accept, loop.predicted, ratio, cost
        )
        damping = 1 / step_size
        change, decrement, damped = step(equations, damping)
        # A step that cannot be computed is no step; `judge` decides what it means.
        finite = jnp.isfinite(decrement)
        change = jax.tree.map(lambda x: jnp.where(finite, x, 0.0), change)
        costs = loop.cost, cost, trial_cost
        termination, undamped_state = undamped_state.judge(
            tolerance(equations), step_size, finite, decrement, is_first, accept, *costs
        )
        return Loop(
            at=at,
            trial=retract(at, change),
            equations=equations,
            cost=cost,
            predicted=jnp.where(finite, 0.5 * (decrement + damping * damped), 0.0),
            step_size=step_size,
            region=region,
            undamped_state=undamped_state,
            termination=termination,
            steps=loop.steps + 1,
        )

    goes_on = lambda loop: (loop.termination == LIMIT) & (loop.steps < max_steps) & go
    return jax.lax.while_loop(goes_on, body, _begin(linearise, start, stopping))


def _begin(linearise: Callable, start: PyTree, stopping: StoppingSettings) -> Loop:
    """The state before the first pass, which accepts the start values."""
    equations, zero = jax.tree.map(
        lambda x: jnp.zeros(x.shape, x.dtype), jax.eval_shape(linearise, start)
    )
    return Loop(
        at=start,
        trial=start,
        equations=equations,
        cost=zero,
        predicted=zero,
        step_size=jnp.full_like(zero, jnp.inf),
        region=RegionState.begin(TRUST_REGION),
        undamped_state=UndampedStepState.begin(stopping),
        termination=jnp.asarray(LIMIT),
        steps=jnp.asarray(0),
    )
