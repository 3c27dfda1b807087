"""Splines of poses: against SciPy's splines, continuity, and products of rotations."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.interpolate import BSpline
from scipy.spatial.transform import Rotation

from jaxbundle.geometry.pose_splines import (
    compose_gibbs,
    cumulative_basis,
    gibbs_vector,
    spline_position,
    turn_back_by_steps,
    turn_by_gibbs,
)
from jaxbundle.leastsquares import Pose, PoseValue
from jaxbundle.network.kinds.continuous_time import place_on_spline

RANDOM = np.random.default_rng(7)
TURNS = Rotation.from_rotvec(np.cumsum(RANDOM.uniform(-0.7, 0.7, (5, 3)), 0))
PLACES = RANDOM.normal(size=(5, 3))


def quaternions(turns):
    return np.roll(turns.as_quat(), 1, axis=-1)


def posed(first, places=PLACES, turns=TURNS):
    value = PoseValue(jnp.asarray(places), jnp.asarray(quaternions(turns)))
    return [
        Pose().prepare(jax.tree.map(lambda x, k=k: x[k], value)) for k in range(first, first + 4)
    ]


def test_positions_are_those_of_a_cubic_spline():
    spline = BSpline(np.arange(-3.0, 6), PLACES, 3)
    for u in (0.0, 0.3, 1.0):
        for first in (0, 1):
            found = spline_position([tuple(p) for p in PLACES[first : first + 4]], u)
            assert np.allclose(found, spline(first + u))


def test_gibbs_vectors_are_rotations():
    one, other = TURNS[1], TURNS[3]
    h = gibbs_vector(tuple(other.as_matrix().ravel()), tuple(one.as_matrix().ravel()))
    step, x = other * one.inv(), RANDOM.normal(size=3)
    assert np.allclose(turn_by_gibbs(h, tuple(x)), step.apply(x))
    half = np.tan(step.magnitude() / 2) * step.as_rotvec() / step.magnitude()
    assert np.allclose(h, half)
    g = gibbs_vector(tuple(one.as_matrix().ravel()), tuple(np.eye(3).ravel()))
    assert np.allclose(turn_by_gibbs(compose_gibbs(h, g), tuple(x)), other.apply(x))


@pytest.mark.parametrize("order", [0, 1, 2])
def test_motion_is_smooth_at_knots(order):
    """Position and rotation to the second derivative; the third jumps."""
    X = (0.3, -0.2, 0.5)

    def derivative(first, u, order):
        f = lambda u: jnp.stack(place_on_spline(posed(first), u, X))
        for _ in range(order):
            f = jax.jacfwd(f)
        return np.asarray(f(u))

    assert np.allclose(derivative(0, 1.0, order), derivative(1, 0.0, order), atol=1e-12)
    if order == 2:
        assert not np.allclose(derivative(0, 1.0, 3), derivative(1, 0.0, 3), atol=1e-2)


def test_rotations_at_the_end_of_a_step():
    """λ_1 = 1 leads to the next control rotation exactly, half of a rotation about one axis is
    nearly half of the angle, and other frames on either side change nothing."""
    axis = Rotation.from_rotvec(np.outer(np.arange(4), [0.0, 0.0, 0.2]))
    at = posed(0, np.zeros((4, 3)), axis)
    x = np.array(place_on_spline(at, 0.5, (1.0, 0.0, 0.0)))
    # the spline of equal steps is the line, half way between the second and the third; tan(θ/2) of
    # a step is linear in u, not θ: 2·(θ/2)³/3 at most
    angle = -np.arctan2(x[1], x[0])
    assert 1e-5 < abs(angle - 0.3) < 2 * 0.1**3 / 3
    left, right = Rotation.from_rotvec([0.3, 1.1, -0.4]), Rotation.from_rotvec([-0.9, 0.2, 0.7])
    X = RANDOM.normal(size=3)
    plain = np.array(place_on_spline(posed(0, 0 * PLACES), 0.4, tuple(X)))
    moved = posed(0, 0 * PLACES, left * TURNS * right)
    other = np.array(place_on_spline(moved, 0.4, tuple(left.apply(X))))
    assert np.allclose(other, right.inv().apply(plain))
    assert turn_back_by_steps([(0.0, 0.0, 0.0)] * 3, 0.2, (1.0, 2.0, 3.0)) == (1.0, 2.0, 3.0)
    assert np.allclose(cumulative_basis(1.0), (1, 5 / 6, 1 / 6))


def test_changes_of_control_poses_are_of_second_order():
    """A moved block is the retracted value to second order in the change, as Hessians need."""
    space, change = Pose(), RANDOM.normal(size=(4, 6))
    value = PoseValue(jnp.asarray(PLACES[:4]), jnp.asarray(quaternions(TURNS[:4])))
    row = lambda tree, k: jax.tree.map(lambda x: x[k], tree)

    def error(size):
        moved, turned = [], []
        for k, d in enumerate(size * change):
            moved.append(space.move(space.prepare(row(value, k)), tuple(d)))
            turned.append(space.prepare(space.retract(row(value, k), jnp.asarray(d))))
        one, other = (place_on_spline(at, 0.37, (0.4, 0.1, -0.6)) for at in (moved, turned))
        return np.abs(np.subtract(one, other)).max()

    assert 6 < error(2e-2) / error(1e-2) < 10
