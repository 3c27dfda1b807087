"""Stopping criteria and terminations: one rule for all adjustments.

With the undamped step δ and g = JᵀPv, the decrement d² = −gᵀδ = δᵀNδ bounds every single unknown:
|δᵢ| ≤ d/σ₀·σᵢ. A problem is *settled* when d ≤ `atol`·σ₀: no unknown would move by more than `atol`
of its own standard deviation. Near the solution the damping is therefore dropped altogether; a
problem whose undamped equations cannot be solved is *singular*, never converged.
"""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

TERMINATIONS = (
    "iteration limit",
    "settled: no unknown would move by more than the tolerance times its standard deviation",
    "relative cost: the sum of squares no longer decreases",
    "singular: the undamped normal equations cannot be solved",
    "stuck: no step reduces the sum of squares",
    "not finite: the residuals of the start values, or of a full step, cannot be computed",
)
LIMIT, SETTLED, RELATIVE_COST, SINGULAR, STUCK, NOT_FINITE = range(6)


def converged(termination):
    """Whether a termination code means that a minimum was reached."""
    return (termination == SETTLED) | (termination == RELATIVE_COST)


ROUNDING = 2e-14
"""A predicted relative decrease of vᵀPv below this is rounding noise."""
COST_ROUNDING = 1e-15
"""Relative precision of a measured value, for estimating that of vᵀPv."""
NOISE_FLOOR, NOISE_FLOOR_WITHOUT_REDUNDANCY = 1e-14, 1e-12
"""Relative precision of a measured value; residuals below it are arithmetic noise.

Without redundancy all residuals vanish and there is no σ0 for stopping: this wider floor is used.
"""
NEAR_SOLUTION = 0.1
"""Near the solution: the last step was predicted to decrease vᵀPv by less than this fraction. A
rejected undamped step makes the limit of its problem ten times narrower, and nothing else: only
those after a damped step that settled count towards `MAX_REJECTED_UNDAMPED`."""
QUADRATIC_GAIN, QUADRATIC_DECREASE = 0.95, 0.5
"""Steps converge quadratically where the gain ratio is above the first, and the predicted decrease
below this fraction of the one before."""
MAX_REJECTED_UNDAMPED = 2
"""Number of rejected undamped steps, after damped ones settled, that means (nearly) singular."""
SHORTEST_STEP = 1e-20
"""The smallest step size worth trying."""


class Tolerance(eqx.Module):
    """Tolerances. `atol`: see the module; `rtol`: stop when an accepted step decreases vᵀPv by less
    than this fraction (0: disabled); `squares`: the sum of the squares of all measured values,
    divided by their σ."""

    redundancy: Float[Array, ""]
    squares: Float[Array, ""]
    atol: Float[Array, ""]
    rtol: Float[Array, ""]

    def limit(self, cost):
        """The decrement d² below which a problem has settled."""
        sigma0_squared = 2 * cost / jnp.maximum(self.redundancy, 1.0)
        precision = jnp.where(self.redundancy > 0, NOISE_FLOOR, NOISE_FLOOR_WITHOUT_REDUNDANCY)
        floor = precision**2 * self.squares
        return jnp.maximum(self.atol**2 * sigma0_squared, ROUNDING * cost) + floor

    def noise(self, cost):
        """Rounding error of a change of ½vᵀPv."""
        return COST_ROUNDING * jnp.sqrt(self.squares * 2 * cost)


class Approach(eqx.Module):
    """State near convergence: the largest relative decrease that is near the solution; the
    decrease predicted for the last accepted step; whether the undamped equations could not be
    solved, whether a settled step is to be repeated without damping, whether the last one was, and
    how many of those were rejected."""

    near: Float[Array, ""]
    predicted: Float[Array, ""]
    singular: Bool[Array, ""]
    repeat_undamped: Bool[Array, ""]
    repeated: Bool[Array, ""]
    rejected: Int[Array, ""]

    @classmethod
    def begin(cls) -> "Approach":
        no = jnp.asarray(False)
        return cls(jnp.asarray(NEAR_SOLUTION), jnp.asarray(0.0), no, no, no, jnp.asarray(0))

    def choose_step(self, step_size, last_size, first, accept, predicted, gain_ratio, cost):
        """The step size, infinite for an undamped step; and the approach after it."""
        # A rejected undamped step was tried too early.
        near = jnp.where(jnp.isinf(last_size) & ~accept, 0.1 * self.near, self.near)
        quadratic = accept & (gain_ratio > QUADRATIC_GAIN) & ~self.singular & ~first
        quadratic &= (predicted < near * cost) & (predicted < QUADRATIC_DECREASE * self.predicted)
        approach = Approach(
            near=near,
            predicted=jnp.where(accept, predicted, self.predicted),
            singular=self.singular,
            repeat_undamped=self.repeat_undamped,
            repeated=self.repeat_undamped,
            rejected=self.rejected + (self.repeated & ~accept),
        )
        return jnp.where(quadratic | self.repeat_undamped, jnp.inf, step_size), approach

    def judge(
        self,
        tolerance: Tolerance,
        step_size,
        finite,
        decrement,
        first,
        accept,
        before,
        cost,
        trial_cost,
    ):
        """The termination code after a step was computed, and the approach.

        `cost`: at the accepted point; `before`: at the one before; `trial_cost`: at the one tried.
        """
        undamped = jnp.isinf(step_size)
        small = finite & (decrement <= tolerance.limit(cost))
        settled = small & undamped
        again = self.singular & undamped & ~finite
        singular = self.singular | (~finite & undamped) | (self.rejected >= MAX_REJECTED_UNDAMPED)
        stalled = accept & ~first & (before - trial_cost < tolerance.rtol * before)
        # Gauss–Newton accepts every step: a sum of squares that grows has not stalled, it diverges.
        stalled &= trial_cost - before <= tolerance.noise(before)
        reasons = (
            (~jnp.isfinite(cost), NOT_FINITE),
            (settled, SETTLED),
            (stalled & ~singular, RELATIVE_COST),
            ((small | stalled) & singular, SINGULAR),
            (again, SINGULAR),
            ((step_size < SHORTEST_STEP) & ~small, STUCK),
        )
        termination = jnp.asarray(LIMIT)
        for happened, reason in reversed(reasons):
            termination = jnp.where(happened, reason, termination)
        # A small damped step says nothing: λ may have made it small.
        repeat = small & ~singular & ~settled
        approach = Approach(
            self.near, self.predicted, singular, repeat, self.repeated, self.rejected
        )
        return termination, approach
