"""Levenberg–Marquardt and Gauss–Newton for networks, on optimistix's public extension points.

`optimistix.least_squares` drives; the parts are ours:

- `SchurDescent` builds the normal blocks and solves them,
- `TrustRegion` accepts or rejects and updates the damping λ (Nielsen 1999),
- `BundleSolver` walks on the manifold of the unknowns and decides when to stop.

Damping is Marquardt's (1963): λ·diag(JᵀPJ), see `damping.py`. Identity damping does not converge on
real blocks: radians stand beside metres and K3 ~ 1e-8.

**When it stops.** With the undamped step δ and g = JᵀPv, the decrement d² = −gᵀδ = δᵀNδ bounds
every single unknown: |δᵢ| ≤ d/σ₀·σᵢ. The network is *settled* when d ≤ `atol`·σ₀: no unknown
would move by more than `atol` of its own standard deviation. Near the solution the damping is
therefore dropped altogether; a network whose undamped equations cannot be solved ends as
*singular*, never as converged.
"""

from collections.abc import Callable
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix as optx
from jaxtyping import Array, Bool, Float, Int

from jaxbundle.adjustment.damping import metric, times
from jaxbundle.adjustment.jacobian import jacobian
from jaxbundle.adjustment.normal import Normal, gradient, normal_from_jacobian
from jaxbundle.adjustment.residuals import half_square, residuals
from jaxbundle.adjustment.schur import factorise, solve
from jaxbundle.network.arrays import Data, Tangent, Values, retract_about
from jaxbundle.network.structure import Structure

TERMINATIONS = (
    "iteration limit",
    "settled: no unknown would move by more than the tolerance times its standard deviation",
    "relative cost: the sum of squares no longer decreases",
    "singular: the undamped normal equations cannot be solved",
    "stuck: no step reduces the sum of squares",
    "not finite: the residuals of the start values, or of a full step, cannot be computed",
)
LIMIT, SETTLED, RELATIVE_COST, SINGULAR, STUCK, NOT_FINITE = range(6)

ROUNDING = 2e-14
"""A predicted decrease of vᵀPv below this fraction of it is rounding noise."""

COST_ROUNDING = 1e-15
"""Relative precision of an image coordinate, to estimate that of vᵀPv."""

NOISE_FLOOR, NOISE_FLOOR_WITHOUT_REDUNDANCY = 1e-14, 1e-12
"""Relative precision of an image coordinate; residuals below it are noise of the arithmetic.

Without redundancy all residuals vanish and no σ0 says when to stop: the wider floor does.
"""

WIDE = 1e8
"""Steps less damped than this need the datum directions made regular."""

INEXACT = 1e-2
"""Relative residual of a reduced system solved by iteration, in the steps of the solver."""

NEAR = 1e-3
"""Near the solution: the last step promised to decrease vᵀPv by less than this fraction."""

KEPT, FALLING = 0.95, 0.1
"""And it kept so much of the promise, which was less than this fraction of the one before."""

REFUSALS = 2
"""So many undamped steps refused where the damped ones have settled: singular, if not exactly."""


class Damped(eqx.Module):
    """The normal equations at the accepted point, and the metric of the damping."""

    normal: Normal
    gradient: Tangent
    metric: Tangent


class SchurDescent(optx.AbstractDescent):
    """The step −(N + λD)⁻¹g by elimination of the points. `step_size` is 1/λ."""

    structure: Structure

    def init(self, y: Values, f_info_struct: Any) -> None:
        return None

    def query(self, y: Values, f_info: optx.FunctionInfo.ResidualJac, state: Any) -> Damped:
        normal = normal_from_jacobian(f_info.jac)
        return Damped(
            normal=normal,
            gradient=gradient(f_info.jac, f_info.residual),
            metric=metric(y, normal),
        )

    def step(self, step_size: Float[Array, ""], state: Damped):
        damping = jax.tree.map(lambda d: d / step_size, state.metric)
        regular = step_size > WIDE
        factor = factorise(self.structure, state.normal, damping, regular, INEXACT)
        change = solve(factor, jax.tree.map(jnp.negative, state.gradient))
        return change, optx.RESULTS.successful


class RegionState(eqx.Module):
    """Radius 1/λ, the factor of the next reduction, what the pending step promises, and how much
    of a change of the cost is rounding."""

    radius: Float[Array, ""]
    reduction: Float[Array, ""]
    predicted: Float[Array, ""]
    noise: Float[Array, ""]
    ratio: Float[Array, ""]


class TrustRegion(optx.AbstractSearch):
    """Accept what decreases vᵀPv; widen by Nielsen's rule, narrow by 2, 4, 8, …"""

    initial: float = 1e4

    def init(self, y: Values, f_info_struct: Any) -> RegionState:
        return RegionState(*(jnp.asarray(x) for x in (self.initial, 2.0, 0.0, 0.0, 0.0)))

    def step(self, first_step, y, y_eval, f_info, f_eval_info, state: RegionState):
        gain = f_info.as_min() - f_eval_info.as_min()
        ratio = jnp.where(state.predicted > 0, gain / state.predicted, -1.0)
        ratio = jnp.where(jnp.isfinite(ratio), ratio, -1.0)
        # A promise smaller than rounding is kept unless the cost visibly grows.
        unseen = (state.predicted < state.noise) & (gain > -state.noise)
        ratio = jnp.where(unseen & (state.predicted > 0), 1.0, ratio)
        accept = first_step | (ratio > 1e-3)
        finite_radius = jnp.minimum(state.radius, 1e16)
        wider = jnp.minimum(1e16, finite_radius / jnp.maximum(1 / 3, 1 - (2 * ratio - 1) ** 3))
        radius = jnp.where(accept, wider, finite_radius / state.reduction)
        radius = jnp.where(first_step, state.radius, radius)
        reduction = jnp.where(accept, 2.0, 2.0 * state.reduction)
        state = RegionState(radius, reduction, state.predicted, state.noise, ratio)
        return radius, accept, optx.RESULTS.successful, state


class FullStep(optx.AbstractSearch):
    """Gauss–Newton: every step undamped, every step taken."""

    initial: ClassVar[float] = jnp.inf

    def init(self, y: Values, f_info_struct: Any) -> RegionState:
        return RegionState(*(jnp.asarray(x) for x in (jnp.inf, 1.0, 0.0, 0.0, 0.0)))

    def step(self, first_step, y, y_eval, f_info, f_eval_info, state: RegionState):
        gain = f_info.as_min() - f_eval_info.as_min()
        state = eqx.tree_at(lambda s: s.ratio, state, gain / state.predicted)
        return jnp.asarray(jnp.inf), jnp.asarray(True), optx.RESULTS.successful, state


class History(eqx.Module):
    """One row an evaluation: ½vᵀPv there, λ of the step that led to it, accepted or not."""

    cost: Float[Array, " steps"]
    damping: Float[Array, " steps"]
    accepted: Bool[Array, " steps"]


class SolverState(eqx.Module):
    """What the loop carries besides the accepted unknowns."""

    first: Bool[Array, ""]
    y_eval: Values
    accepted_info: optx.FunctionInfo.Eval
    search: RegionState
    step_size: Float[Array, ""]
    singular: Bool[Array, ""]
    near: Float[Array, ""]
    promised: Float[Array, ""]
    trial: Bool[Array, ""]
    tried: Bool[Array, ""]
    refusals: Int[Array, ""]
    termination: Int[Array, ""]
    done: Bool[Array, ""]
    steps: Int[Array, ""]
    history: History


class BundleSolver(optx.AbstractLeastSquaresSolver):
    """Least squares of a network: the Schur step under a search, on the manifold.

    **Arguments:** `structure` and `redundancy` of the network (for σ₀ in the stopping rule);
    `atol`: see the module; `rtol`: stop when an accepted step decreases vᵀPv by less than this
    fraction (0: never for this reason); `max_steps` rows of history; `progress(step, cost, λ)`
    is called on the host after every evaluation.
    """

    structure: Structure
    redundancy: Float[Array, ""]
    search: TrustRegion | FullStep = TrustRegion()
    rtol: float = 0.0
    atol: float = 1e-5
    max_steps: int = eqx.field(static=True, default=100)
    progress: Callable | None = eqx.field(static=True, default=None)
    norm: ClassVar[Callable] = staticmethod(optx.max_norm)

    def init(self, fn, y, args, options, f_struct, aux_struct, tags) -> SolverState:
        no, zero = jnp.asarray(False), jnp.asarray(0.0)
        rows = self.max_steps + 1
        return SolverState(
            first=jnp.asarray(True),
            y_eval=y,
            accepted_info=optx.FunctionInfo.Eval(zero),
            search=self.search.init(y, optx.FunctionInfo.Eval(zero)),
            step_size=jnp.asarray(float(self.search.initial)),
            singular=no,
            near=jnp.asarray(NEAR),
            promised=zero,
            trial=no,
            tried=no,
            refusals=jnp.asarray(0),
            termination=jnp.asarray(LIMIT),
            done=no,
            steps=jnp.asarray(0),
            history=History(*(jnp.full(rows, jnp.nan) for _ in range(2)), jnp.zeros(rows, bool)),
        )

    def step(self, fn, y, args, options, state: SolverState, tags):
        s, descent = self.structure, SchurDescent(self.structure)
        dot = lambda a, b: _dot(s, a, b)
        residual, aux = fn(state.y_eval, args)
        info = optx.FunctionInfo.Eval(s.total(half_square(residual)))
        cost, before = info.as_min(), state.accepted_info.as_min()
        step_size, accept, _, search = self.search.step(
            state.first, y, state.y_eval, state.accepted_info, info, state.search
        )
        choose = lambda new, old: jax.tree.map(lambda a, b: jnp.where(accept, a, b), new, old)
        y, accepted_info = choose((state.y_eval, info), (y, state.accepted_info))
        linear = optx.FunctionInfo.ResidualJac(fn(y, args)[0], jacobian(s, y, args))
        damped = descent.query(y, linear, None)
        cost_here = accepted_info.as_min()

        # An undamped step that was refused was tried too early.
        near = jnp.where(jnp.isinf(state.step_size) & ~accept, 0.1 * state.near, state.near)
        # Near the solution, and where the step already is one of rounding, drop the damping.
        undamped = isinstance(self.search, FullStep)
        if not undamped:
            quadratic = accept & (search.ratio > KEPT) & ~state.singular & ~state.first
            quadratic = quadratic & (search.predicted < near * cost_here)
            quadratic = quadratic & (search.predicted < FALLING * state.promised)
            step_size = jnp.where(quadratic | state.trial, jnp.inf, step_size)
        change, _ = descent.step(step_size, damped)
        finite = s.total(1 - _all_finite(change).astype(int)) == 0
        change = jax.tree.map(lambda d: jnp.where(finite, d, 0.0), change)
        decrement = -dot(damped.gradient, change)
        damping_term = dot(change, times(damped.metric, change))
        damping_term = jnp.where(jnp.isinf(step_size), 0.0, damping_term / step_size)
        predicted = 0.5 * (decrement + damping_term)
        y_eval = retract_about(self.structure, y, change)

        sigma0_squared = 2 * cost_here / jnp.maximum(self.redundancy, 1.0)
        scale = args.image_xy * args.image_weight
        precision = jnp.where(
            self.redundancy > 0, NOISE_FLOOR, NOISE_FLOOR_WITHOUT_REDUNDANCY
        )
        squares = s.total(jnp.sum(scale**2))
        floor = precision**2 * squares
        noise = COST_ROUNDING * jnp.sqrt(squares * 2 * cost_here)
        limit = jnp.maximum(self.atol**2 * sigma0_squared, ROUNDING * cost_here) + floor
        small = finite & (decrement <= limit)
        settled = small & jnp.isinf(step_size)
        refusals = state.refusals + (state.tried & ~accept)
        singular = state.singular | (~finite & jnp.isinf(step_size)) | (refusals >= REFUSALS)
        # The full steps of Gauss-Newton are all accepted: what grows visibly has not stalled.
        stalled = accept & ~state.first & (before - cost < self.rtol * before)
        stalled = stalled & (cost - before <= state.search.noise)
        stuck = step_size < 1e-20
        broken = ~jnp.isfinite(cost_here) | (undamped & ~jnp.isfinite(cost))
        reasons = (
            (broken, NOT_FINITE),
            (settled, SETTLED),
            (stalled & ~singular, RELATIVE_COST),
            (small & singular, SINGULAR),
            (stalled & singular, SINGULAR),
            (undamped & ~finite, SINGULAR),
            (stuck & ~small, STUCK),
        )
        termination = jnp.asarray(LIMIT)
        for happened, reason in reversed(reasons):
            termination = jnp.where(happened, reason, termination)
        done = termination != LIMIT
        # A small step that still was damped: try it undamped before calling it settled.
        trial = small & ~singular & ~settled
        y = jax.tree.map(lambda a, b: jnp.where(settled, b, a), y, y_eval)
        i = state.steps
        history = History(
            state.history.cost.at[i].set(cost),
            state.history.damping.at[i].set(jnp.where(state.first, jnp.nan, 1 / state.step_size)),
            state.history.accepted.at[i].set(accept),
        )
        if self.progress is not None:
            jax.debug.callback(self.progress, i, cost, 1 / state.step_size)
        promised = jnp.where(accept, search.predicted, state.promised)
        search = eqx.tree_at(lambda s: (s.predicted, s.noise), search, (predicted, noise))
        new = SolverState(
            first=jnp.asarray(False), y_eval=y_eval, accepted_info=accepted_info, search=search,
            step_size=step_size, singular=singular, near=near,
            promised=promised,
            trial=trial, tried=state.trial, refusals=refusals, termination=termination, done=done,
            steps=i + 1, history=history,
        )  # fmt: skip
        return y, new, aux

    def terminate(self, fn, y, args, options, state: SolverState, tags):
        return state.done, optx.RESULTS.successful

    def postprocess(self, fn, y, aux, args, options, state: SolverState, tags, result):
        # optimistix itself ends the loop where unknowns are not finite, before any step.
        termination = jnp.where(_all_finite(y), state.termination, NOT_FINITE)
        stats = {
            "termination": termination,
            "iterations": state.steps,
            "history": state.history,
        }
        return y, aux, stats


class NoAdjoint(optx.AbstractAdjoint):
    """Run the loop without derivatives: they are attached to its result (`sensitivity.py`)."""

    def apply(self, primal_fn, rewrite_fn, inputs, tags):
        def loop(cond, body, init, max_steps):
            count = lambda carry: cond(carry[0]) & (carry[1] < max_steps)
            step = lambda carry: (body(carry[0]), carry[1] + 1)
            return jax.lax.while_loop(count, step, (init, 0))[0]

        return primal_fn((*inputs, loop))


class Minimum(eqx.Module):
    """Where the loop ended: unknowns, why (`TERMINATIONS`), how many steps, their history."""

    values: Values
    termination: Int[Array, ""]
    iterations: Int[Array, ""]
    history: History


def minimise(solver: BundleSolver, data: Data, start: Values) -> Minimum:
    """Run the solver from `start` by `optimistix.least_squares`; no derivatives."""
    structure = solver.structure
    result = optx.least_squares(
        lambda values, data: residuals(structure, values, data),
        solver,
        start,
        args=data,
        max_steps=solver.max_steps,
        adjoint=NoAdjoint(),
        throw=False,
    )
    return Minimum(
        result.value,
        result.stats["termination"],
        result.stats["iterations"],
        result.stats["history"],
    )


def _dot(s: Structure, a: Tangent, b: Tangent):
    own = s.agreed(jnp.vdot(a.image, b.image) + jnp.vdot(a.camera, b.camera))
    return own + s.total(jnp.vdot(a.point, b.point))


def _all_finite(tree):
    return jnp.all(jnp.stack([jnp.all(jnp.isfinite(x)) for x in jax.tree.leaves(tree)]))
