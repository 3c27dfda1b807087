"""Least squares on manifolds with `optimistix.least_squares`.

From one accepted point to the next, a search accepts or rejects the step tried, a descent computes
the next one, and `stopping` decides when to end. Every step tried costs a factorisation and the
residuals; Jacobian and normal equations are formed at accepted points only.
"""

# Arguments that the interfaces of optimistix prescribe:
# ruff: noqa: ARG002, ARG005

import dataclasses
from collections.abc import Callable, Iterable
from typing import Any, ClassVar, Generic, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix as optx
from jaxtyping import Array, Bool, Float, Int, PyTree

from jaxbundle.leastsquares.equations.normal import (
    Normal,
    NormalBlocks,
    dot,
    normal_equations,
    sum_over_devices,
    zero_tangent,
)
from jaxbundle.leastsquares.indexing.plan import Plan, Tangent
from jaxbundle.leastsquares.indexing.rows import (
    ChunkedData,
    Data,
    Declared,
    Values,
    lay_out_data,
    residuals,
)
from jaxbundle.leastsquares.iterations.retraction import representatives
from jaxbundle.leastsquares.iterations.search import (
    Info,
    MarquardtDescent,
    NielsenTrustRegion,
    compare_with_prediction,
)
from jaxbundle.leastsquares.iterations.stopping import (
    LIMIT,
    NOT_FINITE,
    SETTLED,
    STOPPING,
    StoppingSettings,
    Tolerance,
    UndampedStepState,
)
from jaxbundle.system.programs import compile_once


class History(eqx.Module):
    """One row per evaluation: ½vᵀPv, λ of its step, accepted or not."""

    cost: Float[Array, " steps"]
    damping: Float[Array, " steps"]
    accepted: Bool[Array, " steps"]

    def with_row(
        self,
        i: Int[Array, ""],
        cost: Float[Array, ""],
        damping: Float[Array, ""],
        is_accepted: Bool[Array, ""],
    ) -> "History":
        return History(
            self.cost.at[i].set(cost),
            self.damping.at[i].set(damping),
            self.accepted.at[i].set(is_accepted),
        )


class Linearisation(eqx.Module):
    """Quantities at an accepted point: ½vᵀPv, its gradient, N. `damping`: λ of the step from there
    that is tried."""

    cost: Float[Array, ""]
    gradient: Tangent
    normal: NormalBlocks
    damping: Float[Array, ""]


class SolverState(eqx.Module):
    """The loop state besides the accepted unknowns: the quantities there, and the step to try."""

    first: Bool[Array, ""]
    known: Linearisation
    change: Tangent
    trial: Values
    step_size: Float[Array, ""]
    descent: Any
    search: Any
    undamped_state: UndampedStepState
    termination: Int[Array, ""]
    steps: Int[Array, ""]
    history: History


class LeastSquares(optx.AbstractLeastSquaresSolver):
    """The solver of a planned problem; see the module.

    **Arguments:** `descent` and `search`: ours or optimistix's (those without memory of earlier
    points); `retract(plan, values, change)`: applies a change; `max_steps`: maximum number of
    evaluations; `rows`: of the history, a size of the compiled program (further evaluations are not
    recorded); `progress(step, cost, λ)` is called on the host after every evaluation; `stopping`:
    when the damping is dropped.
    """

    declared: Declared
    plan: Plan
    tolerance: Tolerance
    retract: Callable = eqx.field(static=True)
    descent: optx.AbstractDescent = MarquardtDescent()
    search: optx.AbstractSearch = NielsenTrustRegion()
    max_steps: int | Int[Array, ""] = 100
    rows: int = eqx.field(static=True, default=128)
    progress: Callable | None = eqx.field(static=True, default=None)
    stopping: StoppingSettings = eqx.field(static=True, default=STOPPING)
    # Required by optimistix, and not used: `terminate` decides by `tolerance` and `stopping`.
    rtol: ClassVar[float] = 0.0
    atol: ClassVar[float] = 0.0
    norm: ClassVar[Callable] = staticmethod(optx.max_norm)

    def init(
        self,
        fn: Callable[[Values, ChunkedData], Any],
        y: Values,
        args: ChunkedData,
        options: dict[str, Any],
        f_struct: PyTree[jax.ShapeDtypeStruct],
        aux_struct: PyTree[jax.ShapeDtypeStruct],
        tags: frozenset[object],
    ) -> SolverState:
        struct = eqx.filter_eval_shape(self._linearise, y, args)
        info = eqx.filter_eval_shape(self._info, struct)
        zero, rows = zero_tangent(self.plan), self.rows
        nothing = jnp.full(rows, jnp.nan)
        return SolverState(
            first=jnp.asarray(True),
            known=jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), struct),
            change=zero,
            trial=y,
            step_size=jnp.asarray(jnp.inf),
            descent=self.descent.init(zero, info),
            search=self.search.init(zero, info),
            undamped_state=UndampedStepState.begin(self.stopping),
            termination=jnp.asarray(LIMIT),
            steps=jnp.asarray(0),
            history=History(nothing, nothing, jnp.zeros(rows, bool)),
        )

    def step(
        self,
        fn: Callable[[Values, ChunkedData], Any],
        y: Values,
        args: ChunkedData,
        options: dict[str, Any],
        state: SolverState,
        tags: frozenset[object],
    ) -> tuple[Values, SolverState, Any]:
        information, zero = self._info(state.known), zero_tangent(self.plan)
        residual, aux = fn(state.trial, args)
        # The residuals of the trial point alone: its Jacobian only if it is accepted.
        trial = optx.FunctionInfo.Eval(half_square(self.plan, residual))
        step_size, accept, _, search = self.search.step(
            state.first, zero, state.change, information, trial, state.search
        )
        # Here as well as in our search: those of optimistix do not return them.
        predicted, ratio = compare_with_prediction(information, state.change, trial.f)
        # N is formed again at accepted points only: a rejected step costs residuals and a solution.
        y, linearisation = jax.lax.cond(
            accept,
            lambda: (state.trial, self._linearise(state.trial, args)),
            lambda: (y, state.known),
        )
        step_size, undamped_state = state.undamped_state.choose_step(
            step_size, state.step_size, state.first, accept, predicted, ratio, linearisation.cost
        )
        change, finite = self._next_change(linearisation, step_size, state.descent)
        # d² = −gᵀδ; for an undamped step δᵀNδ.
        costs = information.f, linearisation.cost, trial.f
        decrement = -dot(self.plan, linearisation.gradient, change)
        termination, undamped_state = undamped_state.judge(
            self.tolerance, step_size, finite, decrement, state.first, accept, *costs
        )
        following = self.retract(self.plan, y, change)
        # A settled step is taken without being tried: it moves nothing by more than `atol` σ.
        y = jax.tree.map(lambda a, b: jnp.where(termination == SETTLED, b, a), y, following)
        if self.progress is not None:
            jax.debug.callback(self.progress, state.steps, trial.f, 1 / state.step_size)
        return (
            y,
            SolverState(
                first=jnp.asarray(False),
                known=dataclasses.replace(linearisation, damping=1 / step_size),
                change=change,
                trial=following,
                step_size=step_size,
                descent=state.descent,
                search=search,
                undamped_state=undamped_state,
                termination=termination,
                steps=state.steps + 1,
                history=state.history.with_row(state.steps, trial.f, 1 / state.step_size, accept),
            ),
            aux,
        )

    def terminate(
        self,
        fn: Callable[[Values, ChunkedData], Any],
        y: Values,
        args: ChunkedData,
        options: dict[str, Any],
        state: SolverState,
        tags: frozenset[object],
    ) -> tuple[Bool[Array, ""], Any]:
        ended = (state.termination != LIMIT) | (state.steps >= self.max_steps)
        return ended, optx.RESULTS.successful

    def postprocess(
        self,
        fn: Callable[[Values, ChunkedData], Any],
        y: Values,
        aux: Any,
        args: ChunkedData,
        options: dict[str, Any],
        state: SolverState,
        tags: frozenset[object],
        result: optx.RESULTS,
    ) -> tuple[Values, Any, dict[str, Any]]:
        # Optimistix ends the loop at non-finite unknowns before any step.
        termination = jnp.where(_all_finite(y), state.termination, NOT_FINITE)
        stats = {
            "termination": termination,
            "iterations": state.steps,
            "history": state.history,
        }
        return y, aux, stats

    def _linearise(self, values: Values, chunked: ChunkedData) -> Linearisation:
        equations = normal_equations(self.declared, self.plan, values, chunked)
        return Linearisation(*equations, damping=jnp.asarray(0.0))

    def _info(self, linearisation: Linearisation) -> Info:
        """The information passed to searches and descents."""
        normal, noise = (
            Normal(self.plan, linearisation.normal),
            self.tolerance.noise(linearisation.cost),
        )
        return Info(
            linearisation.cost, linearisation.gradient, normal, linearisation.damping, noise
        )

    def _next_change(
        self, linearisation: Linearisation, step_size: Float[Array, ""], descent_state: Any
    ) -> tuple[Tangent, Bool[Array, ""]]:
        """The descent's step from the accepted point, zero if it cannot be computed."""
        query = self.descent.query(
            zero_tangent(self.plan), self._info(linearisation), descent_state
        )
        change, _ = self.descent.step(step_size, query)
        # All devices must agree, or they take different branches and wait for each other forever.
        finite = sum_over_devices(self.plan, 1 - _all_finite(change).astype(int)) == 0
        return jax.tree.map(lambda d: jnp.where(finite, d, 0.0), change), finite


class NoAdjoint(optx.AbstractAdjoint):
    """Run the loop without derivatives: they are attached to its result (`derivatives.py`)."""

    def apply(
        self, primal_fn: Callable, rewrite_fn: Callable, inputs: tuple, tags: frozenset[object]
    ) -> Any:
        # Optimistix passes its own loop, which is bounded so that it can be differentiated.
        loop = lambda cond, body, init, max_steps: jax.lax.while_loop(cond, body, init)
        return primal_fn((*inputs, loop))


V = TypeVar("V")


class Minimum(eqx.Module, Generic[V]):
    """The end of the loop: unknowns (tables, or those of a network), termination
    (`stopping.TERMINATIONS`), number of evaluations (that of the start values is the first),
    history."""

    values: V
    termination: Int[Array, ""]
    iterations: Int[Array, ""]
    history: History


def minimise(solver: LeastSquares, data: Data, start: Values) -> Minimum[Values]:
    """Run the solver from `start` by `optimistix.least_squares`; no derivatives."""
    chunked = lay_out_data(solver.plan, data)
    fn = lambda values, chunked: residuals(solver.declared, solver.plan, values, chunked)
    solution = optx.least_squares(
        fn, solver, start, chunked, max_steps=None, adjoint=NoAdjoint(), throw=False
    )
    stats = solution.stats
    values = representatives(solver.declared, solution.value, start)
    return Minimum(values, stats["termination"], stats["iterations"], stats["history"])


# Compiled once for all callers.
minimise_compiled = compile_once(minimise)


def half_square(plan: Plan, residual: Iterable[Float[Array, "..."]]) -> Float[Array, ""]:
    """½·vᵀPv of all devices."""
    return sum_over_devices(plan, 0.5 * sum((jnp.vdot(r, r) for r in residual), jnp.zeros(())))


def _all_finite(tree: PyTree) -> Bool[Array, ""]:
    return jnp.stack([jnp.isfinite(x).all() for x in jax.tree.leaves(tree)]).all()
