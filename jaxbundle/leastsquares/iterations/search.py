"""Descents and searches on optimistix's public interfaces; they compose with optimistix's own.

A *descent* turns a step size into a change of the unknowns, a *search* accepts or rejects it and
gives the next step size. Both receive an `optimistix.FunctionInfo.EvalGradHessian`: ½vᵀPv, its
gradient, and N as a linear operator (`normal.Normal`). Unknowns are on manifolds, so points are
passed in the tangent space of the accepted one: `y` is zero, `y_eval` the step tried.
"""

# Arguments that the interfaces of optimistix and lineax prescribe:
# ruff: noqa: ARG002

import dataclasses
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
import optimistix as optx
from jaxtyping import Array, Bool, Float

from jaxbundle.choices import METHODS
from jaxbundle.leastsquares.equations.damping import times
from jaxbundle.leastsquares.equations.elimination import (
    FULL_PRECISION,
    NormalFactor,
    damp,
    factorise,
    solve,
)
from jaxbundle.leastsquares.equations.normal import Normal, dot
from jaxbundle.leastsquares.indexing.plan import Tangent

# `optimistix.FunctionInfo.Eval` of the point tried, which is no class to a type checker.
Evaluation = Any


class Info(optx.FunctionInfo.EvalGradHessian):
    """Quantities at an accepted point: ½vᵀPv, its gradient and N; `damping`: λ of the step from
    there that is tried; `noise`: rounding error of a change of ½vᵀPv."""

    hessian: Normal
    damping: Float[Array, ""]
    noise: Float[Array, ""]


class Elimination(lx.AbstractLinearSolver):
    """Solves with N by elimination, for any descent that takes a linear solver.

    `pin_datum`: with unknowns of open datum directions pinned (`elimination.reduced_system`);
    `tolerance`: relative residual of a reduced system solved iteratively."""

    pin_datum: bool | Bool[Array, ""] = True
    tolerance: float = eqx.field(static=True, default=FULL_PRECISION)

    def init(self, operator: Normal, options: dict[str, Any]) -> NormalFactor:
        if not isinstance(operator, Normal):
            raise ValueError("Elimination solves with the normal equations of a plan only")
        return factorise(operator, self.pin_datum, self.tolerance)

    def compute(
        self, state: NormalFactor, vector: Tangent, options: dict[str, Any]
    ) -> tuple[Tangent, optx.RESULTS, dict[str, Any]]:
        return solve(state, vector), lx.RESULTS.successful, {}

    def transpose(
        self, state: NormalFactor, options: dict[str, Any]
    ) -> tuple[NormalFactor, dict[str, Any]]:
        return state, options

    def conj(
        self, state: NormalFactor, options: dict[str, Any]
    ) -> tuple[NormalFactor, dict[str, Any]]:
        return state, options

    def assume_full_rank(self) -> bool:
        return True


class MarquardtDescent(optx.AbstractDescent):
    """The step −(N + λ·D)⁻¹·g with λ = 1/`step_size`; infinite: undamped. D: `damping.py`.

    - `pin_datum_from`: step size above which the open datum directions are pinned; below it the
      damping alone keeps N regular: λ = 1e-8 leaves them pivots a hundred thousand times those
      that count as rounding (`elimination.PIVOT`).
    - `relative_residual`: of a reduced system that is solved iteratively. The step need not be
      exact: the next one is computed from the true residuals (inexact Newton: Dembo, Eisenstat
      and Steihaug 1982). A residual of η, in the norm of N⁻¹, costs η² of the predicted
      decrease: 1e-4.
    """

    pin_datum_from: float = eqx.field(static=True, default=1e8)
    relative_residual: float = eqx.field(static=True, default=1e-2)

    def init(self, y: Tangent, f_info_struct: Info) -> None:
        return None

    def query(self, y: Tangent, f_info: Info, state: None) -> Info:
        return f_info

    def step(self, step_size: Float[Array, ""], state: Info) -> tuple[Tangent, Any]:
        damped = damp(state.hessian, 1 / step_size)
        # Pins in damped steps, too, would hold single unknowns of the datum and distort the step:
        # 15 evaluations on BAL 16 instead of 10.
        solver = Elimination(step_size > self.pin_datum_from, self.relative_residual)
        change = lx.linear_solve(damped, state.grad, solver, throw=False).value
        return jax.tree.map(jnp.negative, change), optx.RESULTS.successful


@dataclasses.dataclass(frozen=True)
class RegionSettings:
    """The trust region.

    - `initial`: its first radius 1/λ.
    - `sufficient_decrease`: a step is accepted if its gain ratio exceeds this.
    - `largest`: radius beyond which damping is rounding.
    """

    # The radius of Ceres' Levenberg–Marquardt (`initial_trust_region_radius`): λ = 1e-4 of the
    # diagonal, nearly undamped. Nielsen's rule triples it after a good step, so that a poor first
    # radius costs few steps.
    initial: float = 1e4
    # Ceres' `min_relative_decrease`, too: any step that decreases vᵀPv more than by accident.
    sufficient_decrease: float = 1e-3
    # λ·D is then 1e-16 of N, below its rounding.
    largest: float = 1e16


TRUST_REGION = RegionSettings()


class RegionState(eqx.Module):
    """Radius 1/λ, and the number by which the next rejected step divides it."""

    radius: Float[Array, ""]
    divisor: Float[Array, ""]
    settings: RegionSettings = eqx.field(static=True, default=TRUST_REGION)

    @classmethod
    def begin(cls, settings: RegionSettings) -> "RegionState":
        """Before the first step."""
        return cls(jnp.asarray(settings.initial), jnp.asarray(2.0), settings)

    def after(
        self, is_first: Bool[Array, ""], gain_ratio: Float[Array, ""]
    ) -> tuple[Bool[Array, ""], "RegionState"]:
        """Whether a step with this gain ratio is accepted, and the next region.

        With ρ the gain ratio (Nielsen 1999, IMM-REP-1999-05, there for λ = 1/radius):

            accepted:   radius ← radius/max(1/3, 1 − (2ρ − 1)³)
            rejected:   radius ← radius/2, then /4, /8, …

        The cubic has no jumps at thresholds: steps that alternate about a threshold of the older
        rules (Marquardt's factors 10) make the radius oscillate."""
        rules = self.settings
        accept = is_first | (gain_ratio > rules.sufficient_decrease)
        finite = jnp.minimum(self.radius, rules.largest)
        growth = 1 / jnp.maximum(1 / 3, 1 - (2 * gain_ratio - 1) ** 3)
        wider = jnp.minimum(finite * growth, rules.largest)
        radius = jnp.where(accept, wider, finite / self.divisor)
        # The first evaluation is of the start values: no step was taken, its gain ratio is void.
        radius = jnp.where(is_first, self.radius, radius)
        divisor = jnp.where(accept, 2.0, 2.0 * self.divisor)
        return accept, RegionState(radius, divisor, rules)


class NielsenTrustRegion(optx.AbstractSearch):
    """Accept steps that decrease vᵀPv, with a trust region by the rule of Nielsen
    (`RegionState`)."""

    settings: RegionSettings = eqx.field(static=True, default=TRUST_REGION)

    def init(self, y: Tangent, f_info_struct: Info) -> RegionState:
        return RegionState.begin(self.settings)

    def step(
        self,
        first_step: Bool[Array, ""],
        y: Tangent,
        y_eval: Tangent,
        f_info: Info,
        f_eval_info: Evaluation,
        state: RegionState,
    ) -> tuple[Float[Array, ""], Bool[Array, ""], Any, RegionState]:
        change = jax.tree.map(jnp.subtract, y_eval, y)
        _, ratio = compare_with_prediction(f_info, change, f_eval_info.as_min())
        accept, state = state.after(first_step, ratio)
        return state.radius, accept, optx.RESULTS.successful, state


class FullStep(optx.AbstractSearch):
    """Gauss–Newton: every step undamped, every step taken."""

    def init(self, y: Tangent, f_info_struct: Info) -> None:
        return None

    def step(
        self,
        first_step: Bool[Array, ""],
        y: Tangent,
        y_eval: Tangent,
        f_info: Info,
        f_eval_info: Evaluation,
        state: None,
    ) -> tuple[Float[Array, ""], Bool[Array, ""], Any, None]:
        return jnp.asarray(jnp.inf), jnp.asarray(True), optx.RESULTS.successful, None


SEARCHES: dict[str, NielsenTrustRegion | FullStep] = dict(
    zip(METHODS, (NielsenTrustRegion(), FullStep()), strict=True)
)


def compare_with_prediction(
    info: Info, change: Tangent, trial_cost: Float[Array, ""]
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """The predicted decrease of ½vᵀPv, and the gain ratio, of a step from an accepted point to one
    with ½vᵀPv = `trial_cost`."""
    predicted = predicted_decrease(info, change)
    return predicted, gain_ratio(predicted, info.as_min() - trial_cost, info.noise)


def predicted_decrease(info: Info, change: Tangent) -> Float[Array, ""]:
    """The decrease of ½vᵀPv that the linearised residuals predict for a damped step,
    ½(−gᵀδ + λ·δᵀDδ)."""
    plan, D = info.hessian.plan, info.hessian.blocks.damping_matrix
    # ½(vᵀPv − v̂ᵀPv̂) of the linearised residuals v̂ = v + J·δ: with (N + λD)·δ = −g the terms in N
    # cancel, so that no product with N is needed.
    damped = info.damping * dot(plan, change, times(D, change))
    return 0.5 * (damped - dot(plan, info.grad, change))


def gain_ratio(
    predicted: Float[Array, ""], decrease: Float[Array, ""], noise: Float[Array, ""]
) -> Float[Array, ""]:
    """The decrease of ½vᵀPv as a fraction of the predicted one; −1 if it is not finite, or no
    decrease is predicted.

    A prediction below rounding counts as achieved unless the sum of squares visibly grows.
    """
    ratio = jnp.where(predicted > 0, decrease / predicted, -1.0)
    # A residual that is not finite, as of a point behind a camera: rejected, and the radius shrinks
    # until the step stays in the domain.
    ratio = jnp.where(jnp.isfinite(ratio), ratio, -1.0)
    # Without this rule the final steps, whose decrease rounding makes negative as often as
    # positive, are rejected by chance: λ grows until the problem is stuck at its minimum.
    below_rounding = (predicted > 0) & (predicted < noise) & (decrease > -noise)
    return jnp.where(below_rounding, 1.0, ratio)
