"""Stopping criteria and terminations: one rule for all adjustments.

With the undamped step δ and g = JᵀPv, the decrement d² = −gᵀδ = δᵀNδ bounds every single unknown:
|δᵢ| ≤ d/σ₀·σᵢ. A problem is *settled* when d ≤ `atol`·σ₀: no unknown would move by more than `atol`
of its own standard deviation. Near the solution the damping is therefore dropped altogether; a
problem whose undamped equations cannot be solved is *singular*, never converged.
"""

import dataclasses

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxbundle.types import AnyArray

TERMINATIONS = (
    "iteration limit",
    "settled: no unknown would move by more than the tolerance times its standard deviation",
    "relative cost: the sum of squares decreases by less than the tolerance, or no longer",
    "singular: the undamped normal equations cannot be solved",
    "stuck: no step reduces the sum of squares",
    "not finite: the residuals of the start values, or of a full step, cannot be computed",
)
LIMIT, SETTLED, RELATIVE_COST, SINGULAR, STUCK, NOT_FINITE = range(6)


def converged(termination: int | Int[AnyArray, ""]) -> bool | Bool[AnyArray, ""]:
    """Whether a termination code means that a minimum was reached."""
    return (termination == SETTLED) | (termination == RELATIVE_COST)


@dataclasses.dataclass(frozen=True)
class StoppingSettings:
    """When the damping is dropped, and when iterations are given up.

    - `near_solution`: undamped steps are tried once the last step was predicted to decrease vᵀPv by
      less than this fraction.
    - `quadratic_gain`, `quadratic_decrease`: … and if steps converge quadratically, which shows in
      a gain ratio above the first, and in a predicted decrease below the second times the one
      before.
    - `narrowing`: a rejected undamped step was tried too early: `near_solution` of this problem is
      multiplied by this.
    - `max_rejected_undamped`: after this many rejected undamped steps at points where the damped
      steps have settled, the problem is (nearly) singular.
    - `shortest_step`: step sizes 1/λ below this are not tried; the problem is stuck.
    """

    # Measured (`benchmarks/constants.py`) on BAL 16 and BAL 49: 9 and 189 or 190 evaluations, and
    # the same vᵀPv to 3e-14, with 0.01 to 1 for the first, 0.9 to 0.975 for the second, and 0.25 to
    # 1 for the third. They matter far from a minimum (`UndampedStepState.choose_step`), not near
    # it.
    near_solution: float = 0.1
    quadratic_gain: float = 0.95
    quadratic_decrease: float = 0.5
    # Each rejected trial costs an evaluation: with 0.1 a problem wastes one at most for every
    # decimal digit by which its predicted decrease falls.
    narrowing: float = 0.1
    # With 1 a single step rejected by rounding would be called singular; with 4 every nearly
    # singular problem takes four more evaluations: a damped and an undamped step for each
    # rejection. The problems above take the same with 1.
    max_rejected_undamped: int = 2
    # λ = 1e20 times the diagonal moves no unknown by its last digit.
    shortest_step: float = 1e-20


STOPPING = StoppingSettings()


class Tolerance(eqx.Module):
    """Tolerances.

    - `redundancy`: of the problem, for σ₀.
    - `squares`: Σ(l/σ)² of all measured values l.
    - `atol`: see the module; `rtol`: stop when an accepted step decreases vᵀPv by less than this
      fraction (0: only when it does not decrease it, and the increase is rounding).
    - `rounding`: a decrement d² below this fraction of ½vᵀPv is rounding.
    - `cost_rounding`: relative rounding error of a measured value, for that of vᵀPv.
    - `noise_floor`: residuals below this fraction of the measured values are arithmetic noise;
      without redundancy all residuals vanish, there is no σ₀ to compare steps with, and
      `noise_floor_without_redundancy` alone ends the iterations.
    """

    redundancy: Float[Array, ""]
    squares: Float[Array, ""]
    atol: Float[Array, ""]
    rtol: Float[Array, ""]
    # A hundred units of rounding (2.2e-16): the sum of some thousand squares. Half or double end
    # BAL 16 after the same evaluation.
    rounding: float = eqx.field(static=True, default=2e-14)
    # 1e-15 and 1e-14: five and fifty units, of a measured value and of a residual computed from it
    # by some tens of operations. Without redundancy the iterations could go on to 1e-14, but gain
    # nothing: there are no residuals whose σ₀ they would be compared with.
    cost_rounding: float = eqx.field(static=True, default=1e-15)
    noise_floor: float = eqx.field(static=True, default=1e-14)
    noise_floor_without_redundancy: float = eqx.field(static=True, default=1e-12)

    def limit(self, cost: Float[Array, ""]) -> Float[Array, ""]:
        """The decrement d² below which a problem has settled."""
        # d ≤ atol·σ₀, or, where residuals nearly vanish, a decrease that rounding of vᵀPv would
        # hide; the floor lets problems without residuals end, whose vᵀPv is noise to the last
        # digit.
        sigma0_squared = 2 * cost / jnp.maximum(self.redundancy, 1.0)
        precision = jnp.where(
            self.redundancy > 0, self.noise_floor, self.noise_floor_without_redundancy
        )
        floor = precision**2 * self.squares
        return jnp.maximum(self.atol**2 * sigma0_squared, self.rounding * cost) + floor

    def noise(self, cost: Float[Array, ""]) -> Float[Array, ""]:
        """Rounding error of a change of ½vᵀPv."""
        # d(½vᵀPv) = vᵀP·dv with |dv| = ε·|l|: at most ε·√(lᵀPl)·√(vᵀPv) (Cauchy and Schwarz).
        return self.cost_rounding * jnp.sqrt(self.squares * 2 * cost)


class UndampedStepState(eqx.Module):
    """What decides whether the next step is undamped, and whether the equations are singular.

    `near_limit`: the largest relative decrease that counts as near the solution; `predicted`: the
    decrease predicted for the last accepted step; `singular`: the undamped equations could not be
    solved; `repeat_undamped`: a settled damped step is to be repeated without damping; `repeated`:
    the last one was; `rejected`: how many of those were rejected.
    """

    near_limit: Float[Array, ""]
    predicted: Float[Array, ""]
    singular: Bool[Array, ""]
    repeat_undamped: Bool[Array, ""]
    repeated: Bool[Array, ""]
    rejected: Int[Array, ""]
    settings: StoppingSettings = eqx.field(static=True, default=STOPPING)

    @classmethod
    def begin(cls, settings: StoppingSettings) -> "UndampedStepState":
        """Before the first step."""
        no, near_limit = jnp.asarray(False), jnp.asarray(settings.near_solution)
        # A predicted decrease of 0: no step is "less than half of the one before" at first.
        return cls(near_limit, jnp.asarray(0.0), no, no, no, jnp.asarray(0), settings)

    def choose_step(
        self,
        step_size: Float[Array, ""],
        last_size: Float[Array, ""],
        is_first: Bool[Array, ""],
        accept: Bool[Array, ""],
        predicted: Float[Array, ""],
        gain_ratio: Float[Array, ""],
        cost: Float[Array, ""],
    ) -> tuple[Float[Array, ""], "UndampedStepState"]:
        """The step size, infinite for an undamped step; and the next state."""
        # Undamped steps are the faster ones where the problem is nearly quadratic, and wasted
        # elsewhere. The rule, with ρ the gain ratio of the last step and q its predicted decrease:
        #
        #     try undamped  if  ρ > 0.95, q < near_limit·½vᵀPv and q < 0.5·(q of the step before)
        #     if rejected   near_limit ← 0.1·near_limit
        #
        # Alternatives on BAL 49: with an undamped step after every good one, every second
        # evaluation was wasted; with the tenfold narrowing after a rejection as well, 5 of the
        # first 60; with the condition on q as well (measured with 0.1 instead of 0.5) none, and a
        # street of 200 images converges after 31 evaluations instead of 36.
        rules = self.settings
        # A rejected undamped step was tried too early.
        is_rejected = jnp.isinf(last_size) & ~accept
        near_limit = jnp.where(is_rejected, rules.narrowing * self.near_limit, self.near_limit)
        quadratic = accept & (gain_ratio > rules.quadratic_gain) & ~self.singular & ~is_first
        decrease = rules.quadratic_decrease
        quadratic &= (predicted < near_limit * cost) & (predicted < decrease * self.predicted)
        state = dataclasses.replace(
            self,
            near_limit=near_limit,
            predicted=jnp.where(accept, predicted, self.predicted),
            repeated=self.repeat_undamped,
            # Only steps after a damped one that settled count: one tried too early says nothing
            # about the equations, and problems far from the minimum have many of them.
            rejected=self.rejected + (self.repeated & ~accept),
        )
        return jnp.where(quadratic | self.repeat_undamped, jnp.inf, step_size), state

    def judge(
        self,
        tolerance: Tolerance,
        step_size: Float[Array, ""],
        finite: Bool[Array, ""],
        decrement: Float[Array, ""],
        is_first: Bool[Array, ""],
        accept: Bool[Array, ""],
        previous_cost: Float[Array, ""],
        cost: Float[Array, ""],
        trial_cost: Float[Array, ""],
    ) -> tuple[Int[Array, ""], "UndampedStepState"]:
        """The termination code after a step was computed, and the next state.

        `cost`: at the accepted point; `previous_cost`: at the one before; `trial_cost`: at the one
        tried.
        """
        rules, undamped = self.settings, jnp.isinf(step_size)
        # The decrement of a damped step underestimates that of the undamped one, so that only an
        # undamped step settles; `repeat` below asks for it.
        small = finite & (decrement <= tolerance.limit(cost))
        settled = small & undamped
        # Levenberg–Marquardt goes on with damping after a failure, until a damped step is small and
        # the undamped one that repeats it fails as well; a failure far from the minimum says
        # nothing. Gauss–Newton has no other step, and fails again at the same point.
        has_failed = undamped & ~finite & (self.singular | self.repeated)
        # Equations that can only just be factorised send undamped steps anywhere: each is rejected
        # although the damped ones have settled. Twice, since once may be an accident of rounding.
        undamped_rejected_too_often = self.rejected >= rules.max_rejected_undamped
        singular = self.singular | (undamped & ~finite) | undamped_rejected_too_often
        # `is_first`: the start values were evaluated, no step was taken.
        has_stalled = (
            accept & ~is_first & (previous_cost - trial_cost < tolerance.rtol * previous_cost)
        )
        # Gauss–Newton accepts every step: a sum of squares that grows has not stalled, it diverges.
        has_stalled &= trial_cost - previous_cost <= tolerance.noise(previous_cost)
        reasons = (
            (~jnp.isfinite(cost), NOT_FINITE),
            (settled, SETTLED),
            (has_stalled & ~singular, RELATIVE_COST),
            ((small & undamped_rejected_too_often) | (has_stalled & singular), SINGULAR),
            (has_failed, SINGULAR),
            # A small step is repeated without damping first. What is left cannot be computed
            # however large λ is, or its decrement is rounding that does not fall with 1/λ.
            ((step_size < rules.shortest_step) & ~small, STUCK),
        )
        termination = jnp.asarray(LIMIT)
        # The first reason that holds counts.
        for happened, reason in reversed(reasons):
            termination = jnp.where(happened, reason, termination)
        # A small damped step says nothing: λ may have made it small.
        repeat = small & ~undamped_rejected_too_often & ~settled
        return termination, dataclasses.replace(self, singular=singular, repeat_undamped=repeat)
