"""Spaces of unknowns: changes there and back, and values of rows that are held."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxbundle.leastsquares.spaces import Direction, Frame, Pose, PoseValue, Rotation, Vector

random = np.random.default_rng(5)


def unit(size):
    value = random.normal(size=size)
    return jnp.asarray(value / np.linalg.norm(value))


def pose():
    return PoseValue(jnp.asarray(random.normal(size=3)), unit(4))


SPACES = {
    "number": (Vector(0), lambda: jnp.asarray(random.normal())),
    "vector": (Vector(3), lambda: jnp.asarray(random.normal(size=3))),
    "rotation": (Rotation(), lambda: unit(4)),
    "pose": (Pose(), pose),
    "frame": (Frame(), pose),
    "direction": (Direction(3), lambda: unit(3)),
}


def assert_equal(found, expected):
    for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize("name", SPACES)
def test_held_rows_keep_the_given_value_and_free_ones_their_own(name):
    space, draw = SPACES[name]
    value, given = draw(), draw()
    assert_equal(space.hold(value, given, jnp.zeros(space.width)), given)
    assert_equal(space.hold(value, given, jnp.ones(space.width)), value)


@pytest.mark.parametrize("name", SPACES)
def test_a_change_leads_there_and_the_difference_back(name):
    """To first order, relative to the point from which it starts; nothing leads nowhere."""
    space, draw = SPACES[name]
    value, change = draw(), 1e-5 * random.normal(size=space.width)
    there = space.retract(value, jnp.asarray(change))
    np.testing.assert_allclose(space.difference(there, value), change, atol=1e-9)
    np.testing.assert_allclose(space.difference(value, value), 0.0, atol=1e-12)
