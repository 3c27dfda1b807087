"""Visibility of targets against geometry by hand, and its limit."""

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import jaxbundle
from jaxbundle.network_design.conditions import Conditions
from jaxbundle.network_design.visibility import margins, rules_of, view_of, visibility, visible

CAMERA = jaxbundle.Camera(
    "cam", "brown", {"c": 20.0}, image_size=(3000, 2000), pixel_size=(0.01, 0.01)
)
HERE, UPRIGHT = np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0])


@cache
def view_and_interior(edge=0.0):
    view = view_of(CAMERA, edge)
    interior = np.zeros(len(view.model.parameters))
    interior[view.model.parameters.index("c")] = 20.0
    return view, interior


def found(point, conditions, softness=0.0, normal=None):
    """The margins of a camera at the origin that looks down −Z."""
    view, interior = view_and_interior(conditions.edge)
    rules = rules_of(conditions, np.zeros(3))
    at = jnp.asarray(point, float)
    return margins(view, rules, HERE, UPRIGHT, interior, at, normal, softness)


def seen(point, conditions, normal=None):
    return {k for k, ok in visible(found(point, conditions, normal=normal)).items() if not ok}


@pytest.mark.parametrize(
    ("point", "inside"),
    [((0, 0, -1), True), ((0, 0, 1), False), ((0.74, 0.49, -1), True), ((0.76, 0, -1), False),
     ((0, -0.51, -1), False), ((0.74, 0.49, 1), False), ((5, 0, 0.0), False)],
)  # fmt: skip
def test_the_format(point, inside):
    assert (seen(point, Conditions()) == set()) == inside


def test_conditions_by_name():
    rules = Conditions(distance=(1, 3), focus=(2, 2.5), incidence=0.5, normals=(0, 0, 1), edge=0.1)
    up = np.array([0.0, 0.0, 1.0])
    assert seen((0, 0, -2.2), rules, up) == set()
    assert seen((0, 0, -4), rules, up) == {"distance", "focus"}
    assert seen((0, 0, -2.9), rules, up) == {"focus"}
    assert seen((0, 0, -2.2), rules, np.array([0.6, 0.0, 0.8])) == {"incidence"}
    assert seen((1.4, 0, -2.2), rules, up) == {"field of view", "incidence"}


def test_obstacles_hide_what_is_behind_them():
    """Against many points along the ray."""
    random = np.random.default_rng(4)
    box = np.array([[-0.2, -0.3, -1.5], [0.25, 0.1, -1.2]])
    rules = Conditions(obstacles=((tuple(box[0]), tuple(box[1])),))
    points = random.uniform([-0.8, -0.6, -3], [0.8, 0.6, -1], (60, 3))
    view_and_interior()
    free = jax.jit(jax.vmap(lambda point: visible(found(point, rules))["obstacles"]))(points)
    for point, seen in zip(points, free):
        along = np.linspace(0, 1, 20001)[:, None] * point
        assert seen != ((along > box[0]) & (along < box[1])).all(1).any()


def test_a_wall_hides_softly_and_its_own_targets_are_seen():
    wall = Conditions(obstacles=(((-1, -1, -2.001), (1, 1, -2.0)),))
    weight = lambda point, s: float(visibility(found(point, wall, s), s))
    for softness in (0.3, 0.1, 0.03):
        assert weight((0, 0, -2.5), softness) < 0.2
    assert weight((0, 0, -2.0), 0.03) > 0.7
    assert weight((0, 0, -1.0), 0.03) > 0.95


def test_weights_become_zero_and_one():
    random = np.random.default_rng(1)
    rules = Conditions(distance=(0.5, 3.0), focus=(0.4, 2.0))
    points = random.uniform([-2, -2, -3], [2, 2, 1], (300, 3))

    def both(point):
        m = found(point, rules, 1e-3)
        return jnp.concatenate([jnp.ravel(x) for x in m.values()]), visibility(m, 1e-3)

    view_and_interior()
    m, weight = map(np.asarray, jax.jit(jax.vmap(both))(points))
    clear = np.abs(m).min(1) > 0.02
    np.testing.assert_allclose(weight[clear], (m > 0).all(1)[clear], atol=1e-6)
    assert 5 < (m > 0).all(1)[clear].sum() < clear.sum() - 5


def test_rotated_cameras_see_what_is_in_front():
    turn = Rotation.from_euler("xyz", [0.3, 1.2, -2.0])
    x, y, z, w = turn.as_quat()
    view, interior = view_and_interior()
    rules, X0 = rules_of(Conditions(), np.zeros(3)), np.array([1.0, 2.0, 3.0])
    ahead = X0 + turn.as_matrix().T @ np.array([0.1, -0.2, -2.0])
    behind = X0 - (ahead - X0)
    q = np.array([w, x, y, z])
    see = lambda X: visible(margins(view, rules, X0, q, interior, X, None))["field of view"]
    assert see(ahead) and not see(behind)
