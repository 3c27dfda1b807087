"""Descents and searches on optimistix's public interfaces; they compose with optimistix's own.

A *descent* turns a step size into a change of the unknowns, a *search* accepts or rejects it and
gives the next step size. Both receive an `optimistix.FunctionInfo.EvalGradHessian`: ½vᵀPv, its
gradient, and N as a linear operator (`normal.Normal`). Unknowns are on manifolds, so points are
passed in the tangent space of the accepted one: `y` is zero, `y_eval` the step tried.
"""

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
    Factor,
    damp,
    factorise,
    solve,
)
from jaxbundle.leastsquares.equations.normal import Normal, Tangent, dot


class Info(optx.FunctionInfo.EvalGradHessian):
    """Quantities at an accepted point: ½vᵀPv, its gradient and N; `damping`: λ of the step under
    test; `noise`: rounding error of a change of ½vᵀPv."""

    hessian: Normal
    damping: Float[Array, ""]
    noise: Float[Array, ""]


SUFFICIENT_DECREASE = 1e-3
"""A step is accepted if it achieves this fraction of the predicted decrease."""
LARGEST_RADIUS = 1e16
"""Radius of the trust region beyond which damping is rounding."""
UNDAMPED_DATUM = 1e8
"""Steps with less damping need regularised datum directions."""
INEXACT = 1e-2
"""Relative residual of an iteratively solved reduced system, in the steps of the solver."""


class Elimination(lx.AbstractLinearSolver):
    """Solves with N by elimination, for any descent that takes a linear solver."""

    regular: bool | Bool[Array, ""] = True
    tolerance: float = eqx.field(static=True, default=FULL_PRECISION)

    def init(self, operator: Normal, options: dict[str, Any]) -> Factor:
        if not isinstance(operator, Normal):
            raise ValueError("Elimination solves with the normal equations of a plan only")
        return factorise(operator, self.regular, self.tolerance)

    def compute(self, state: Factor, vector: Tangent, options: dict[str, Any]):
        return solve(state, vector), lx.RESULTS.successful, {}

    def transpose(self, state: Factor, options: dict[str, Any]):
        return state, options

    def conj(self, state: Factor, options: dict[str, Any]):
        return state, options

    def assume_full_rank(self) -> bool:
        return True


class MarquardtDescent(optx.AbstractDescent):
    """The step −(N + λ·D)⁻¹·g with λ = 1/`step_size`; infinite: undamped."""

    undamped: float = eqx.field(static=True, default=float("inf"))

    def init(self, y: Tangent, f_info_struct: Info) -> None:
        return None

    def query(self, y: Tangent, f_info: Info, state: None) -> Info:
        return f_info

    def step(self, step_size: Float[Array, ""], state: Info):
        damped = damp(state.hessian, 1 / step_size)
        solver = Elimination(step_size > UNDAMPED_DATUM, INEXACT)
        change = lx.linear_solve(damped, state.grad, solver, throw=False).value
        return jax.tree.map(jnp.negative, change), optx.RESULTS.successful


class RegionState(eqx.Module):
    """Radius 1/λ, and the number by which the next rejected step divides it."""

    radius: Float[Array, ""]
    divisor: Float[Array, ""]

    @classmethod
    def begin(cls, radius: float = 1e4) -> "RegionState":
        return cls(jnp.asarray(radius), jnp.asarray(2.0))

    def after(self, first, gain_ratio) -> tuple[Bool[Array, ""], "RegionState"]:
        """Whether a step with this gain ratio is accepted, and the next region: widened by the rule
        of Nielsen (1999), narrowed by 2, 4, 8, …"""
        accept = first | (gain_ratio > SUFFICIENT_DECREASE)
        finite = jnp.minimum(self.radius, LARGEST_RADIUS)
        growth = 1 / jnp.maximum(1 / 3, 1 - (2 * gain_ratio - 1) ** 3)
        wider = jnp.minimum(finite * growth, LARGEST_RADIUS)
        radius = jnp.where(accept, wider, finite / self.divisor)
        radius = jnp.where(first, self.radius, radius)
        return accept, RegionState(radius, jnp.where(accept, 2.0, 2.0 * self.divisor))


class NielsenTrustRegion(optx.AbstractSearch):
    """Accept steps that decrease vᵀPv, with a trust region by the rule of Nielsen
    (`RegionState`)."""

    initial: float = 1e4

    def init(self, y: Tangent, f_info_struct: Info) -> RegionState:
        return RegionState.begin(self.initial)

    def step(self, first_step, y, y_eval, f_info, f_eval_info, state: RegionState):
        change = jax.tree.map(jnp.subtract, y_eval, y)
        predicted = predicted_decrease(f_info, change)
        decrease = f_info.as_min() - f_eval_info.as_min()
        accept, state = state.after(first_step, gain_ratio(predicted, decrease, f_info.noise))
        return state.radius, accept, optx.RESULTS.successful, state


class FullStep(optx.AbstractSearch):
    """Gauss–Newton: every step undamped, every step taken."""

    def init(self, y: Tangent, f_info_struct: Info) -> None:
        return None

    def step(self, first_step, y, y_eval, f_info, f_eval_info, state: None):
        return jnp.asarray(jnp.inf), jnp.asarray(True), optx.RESULTS.successful, None


SEARCHES: dict[str, NielsenTrustRegion | FullStep] = dict(
    zip(METHODS, (NielsenTrustRegion(), FullStep()), strict=True)
)


def predicted_decrease(info: Info, change: Tangent) -> Float[Array, ""]:
    """The decrease of ½vᵀPv that the linearised residuals predict for a damped step,
    ½(−gᵀδ + λ·δᵀDδ)."""
    plan, D = info.hessian.plan, info.hessian.blocks.damping_matrix
    damped = info.damping * dot(plan, change, times(D, change))
    return 0.5 * (damped - dot(plan, info.grad, change))


def gain_ratio(predicted, decrease, noise) -> Float[Array, ""]:
    """The decrease of ½vᵀPv as a fraction of the predicted one; −1 if it is not finite.

    A prediction below rounding counts as achieved unless the sum of squares visibly grows.
    """
    ratio = jnp.where(predicted > 0, decrease / predicted, -1.0)
    ratio = jnp.where(jnp.isfinite(ratio), ratio, -1.0)
    below_rounding = (predicted > 0) & (predicted < noise) & (decrease > -noise)
    return jnp.where(below_rounding, 1.0, ratio)
