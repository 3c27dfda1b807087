"""Where iterations end: the rules of stopping on problems whose iterations are known by hand."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest

from jaxbundle import leastsquares as ls
from jaxbundle.leastsquares.datum.conditions import DATUM_MOTION, moves_on
from jaxbundle.leastsquares.iterations.search import TRUST_REGION, RegionState
from jaxbundle.leastsquares.iterations.stopping import (
    LIMIT,
    SETTLED,
    SINGULAR,
    STOPPING,
    Tolerance,
    UndampedStepState,
)

ANGLE = ls.Kind("angle", lambda x, measured: jnp.arctan(x) - measured, of=("x",))


@pytest.mark.parametrize("start", [1.2, 1.5])
def test_gauss_newton_that_diverges_has_not_converged(start):
    """x ← x − (1 + x²)·arctan x (Dennis and Schnabel 1983, 5.2): from beyond 1.3917 every step is
    farther from the root 0, and the sum of squares grows towards (π/2)²."""
    angles = ANGLE((np.zeros(2, int),), np.zeros((2, 1)), sigma=1.0)
    problem = [ls.Table("x", np.array([[start]]))], [angles]
    found = ls.adjust(*problem, method="gauss-newton")
    assert found.converged == (start < 1.3917)
    damped = ls.adjust(*problem)
    assert damped.converged
    np.testing.assert_allclose(damped["x"].value, 0.0, atol=1e-6)


STEP = {"last_size": 1.0, "is_first": False, "accept": True, "predicted": 0.04, "gain_ratio": 0.99}


@pytest.mark.parametrize("other", [
    {}, {"gain_ratio": 0.9}, {"predicted": 0.06}, {"predicted": 0.15}, {"is_first": True},
    {"accept": False},
])  # fmt: skip
def test_the_damping_is_dropped_where_steps_converge_quadratically(other):
    """Gain ratio near 1, and a predicted decrease below a tenth of the cost and half of the one
    before: 0.1 in the first case and all others but that of 0.15, which is below half of 1."""
    before = jnp.asarray(1.0 if other.get("predicted") == 0.15 else 0.1)
    state = dataclasses.replace(UndampedStepState.begin(STOPPING), predicted=before)
    step = {name: jnp.asarray(value) for name, value in (STEP | other).items()}
    size, after = state.choose_step(jnp.asarray(3.0), cost=jnp.asarray(1.0), **step)
    assert size == (3.0 if other else jnp.inf)
    assert after.predicted == (step["predicted"] if step["accept"] else before)
    # equations that could not be solved without damping are damped to the end
    singular = dataclasses.replace(state, singular=jnp.asarray(True))
    assert singular.choose_step(jnp.asarray(3.0), cost=jnp.asarray(1.0), **step)[0] == 3.0


@pytest.mark.parametrize("last_size, again", [(1.0, jnp.inf), (jnp.inf, 3.0)])
def test_a_rejected_undamped_step_was_tried_too_early(last_size, again):
    """After it, a decrease ten times smaller counts as near the minimum; a rejected damped step
    changes nothing."""
    state = dataclasses.replace(UndampedStepState.begin(STOPPING), predicted=jnp.asarray(0.1))
    step = {name: jnp.asarray(value) for name, value in STEP.items()}
    sizes = {"step_size": jnp.asarray(3.0), "cost": jnp.asarray(1.0)}
    rejected = {"last_size": jnp.asarray(last_size), "accept": jnp.asarray(False)}
    _, state = state.choose_step(**sizes, **(step | rejected))
    assert state.choose_step(**sizes, **step)[0] == again
    assert state.choose_step(**sizes, **(step | {"predicted": jnp.asarray(0.009)}))[0] == jnp.inf


def test_the_trust_region_follows_nielsen():
    """Radius 1/λ: steps rejected in a row divide it by 2, 4, 8; an accepted one multiplies it by
    1/max(1/3, 1 − (2ρ − 1)³), and the next rejected one divides by 2 again (Nielsen 1999, 3.3)."""
    region, step = RegionState.begin(TRUST_REGION), jnp.asarray(False)
    ratios = [-1.0, 0.0, -0.5, 0.9, -1.0, 0.5, 1.0, 0.1]
    factors = [1 / 2, 1 / 4, 1 / 8, 1 / (1 - 0.8**3), 1 / 2, 1.0, 3.0, 1 / (1 + 0.8**3)]
    for ratio, factor in zip(ratios, factors, strict=True):
        accepted, after = region.after(step, jnp.asarray(ratio))
        assert accepted == (ratio > 0)
        assert after.radius == pytest.approx(float(region.radius) * factor, rel=1e-12)
        region = after


def test_a_motion_to_the_datum_ends():
    """It goes on while its steps are long, or halve; never without end, as a step that turns to and
    fro would."""
    size, most = np.float64(1.0), DATUM_MOTION.max_steps
    near, arrived = 0.5 * DATUM_MOTION.small, 0.5 * DATUM_MOTION.reached
    assert moves_on(size, 0.5, 0.4, most - 1) and not moves_on(size, 0.5, 0.4, most)
    assert moves_on(size, near, 2.1 * near, 1) and not moves_on(size, near, 1.9 * near, 1)
    assert not moves_on(size, arrived, 1.0, 1)


def test_a_factorisation_that_failed_far_from_the_minimum_is_tried_again_there():
    """A small damped step is repeated without damping, and that one decides, also after an earlier
    failure; equations that send it away twice are singular."""
    tolerance = Tolerance(*(jnp.asarray(x) for x in (10.0, 1e4, 1e-3, 0.0)))
    far = dataclasses.replace(UndampedStepState.begin(STOPPING), singular=jnp.asarray(True))

    def judge(state, step_size, decrement, finite=True):
        given = (jnp.asarray(x) for x in (step_size, finite, decrement, False, True, 5.1, 5.0, 5.0))
        termination, state = state.judge(tolerance, *given)
        return int(termination), state

    small, inf = 1e-12, np.inf
    termination, state = judge(far, 1e4, small)
    assert termination == LIMIT and state.repeat_undamped
    again = dataclasses.replace(state, repeated=jnp.asarray(True))
    assert judge(again, inf, small)[0] == SETTLED
    assert judge(again, inf, small, finite=False)[0] == SINGULAR
    begun = dataclasses.replace(UndampedStepState.begin(STOPPING), repeated=jnp.asarray(True))
    assert judge(begun, inf, small, finite=False)[0] == SINGULAR
    twice = dataclasses.replace(far, rejected=jnp.asarray(2))
    assert judge(twice, 1e4, small)[0] == SINGULAR
