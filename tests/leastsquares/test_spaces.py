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


FIGURES = {
    "plane": (2, 3, 4),
    "axis": (0, 1, 3, 4),
    "circle": (0, 1, 2, 3, 4),
    "sphere": (0, 1, 2),
    "body": (0, 1, 2, 3, 4, 5),
}


@pytest.mark.parametrize("columns", FIGURES.values(), ids=FIGURES)
def test_the_representative_of_a_figure_does_not_depend_on_the_way_to_it(columns):
    """A frame moved in itself has the same representative; it is the same figure, and nearest to
    the given frame: that of the given figure, moved in itself, is the given frame."""
    space, value = Frame(columns), pose()
    given = Frame().retract(value, jnp.asarray(0.3 * random.normal(size=6)))
    nearest = space.representative(value, given)

    def moved_in_itself(frame):
        step = 0.5 * random.normal(size=6)
        step[list(columns)] = 0.0
        return Frame().retract(frame, jnp.asarray(step))

    for found, right in (
        (space.representative(moved_in_itself(value), given), nearest),
        (space.representative(moved_in_itself(given), given), given),
    ):
        np.testing.assert_allclose(found.position, right.position, atol=1e-14)
        q, p = found.rotation, right.rotation
        np.testing.assert_allclose(abs(q @ p), 1.0, atol=1e-14)
    own = {3, 4, 5} - set(columns)
    gauge = Frame().difference(nearest, value)
    if own in ({5}, set()):  # rotations about several axes do not add up
        np.testing.assert_allclose(gauge[jnp.array(columns)], 0.0, atol=1e-13)
