"""The motions that are assumed for a problem whose datum is open."""

import jax.numpy as jnp
import numpy as np
import pytest

from jaxbundle import leastsquares as ls
from jaxbundle.leastsquares.datum.conditions import generators, keep_held_fixed
from jaxbundle.leastsquares.datum.motions import likely_motions
from jaxbundle.leastsquares.problem import complete_data

POINTS = ls.Table("point", np.zeros((4, 3)))
POSES = ls.Table("pose", ls.PoseValue(np.zeros((2, 3)), np.tile([1.0, 0, 0, 0], (2, 1))))
PLACES = ls.Table("place", np.zeros((4, 2)))
HEIGHTS, SCALES = ls.Table("height", np.zeros(4)), ls.Table("scale", np.ones(2))


@pytest.mark.parametrize("tables, number, moved", [
    ([POINTS], 7, ["point"]),
    ([POSES, HEIGHTS], 7, ["pose"]),
    ([HEIGHTS, POINTS, PLACES, POSES], 7, ["point", "pose"]),
    ([HEIGHTS, PLACES], 4, ["place"]),
    ([HEIGHTS, SCALES], 1, ["height"]),
])  # fmt: skip
def test_a_similarity_of_the_coordinates_else_a_shift(tables, number, moved):
    motions = likely_motions(tables)
    assert len(motions.names) == number and [name for name, _ in motions.actions] == moved


def test_tables_of_other_values_have_no_motions():
    assert likely_motions([ls.Table("coefficients", np.zeros((4, 5)))]) is None


@pytest.mark.parametrize("offset", [0.0, 1e5])
def test_open_motions_leave_held_points_wherever_they_are(offset):
    """Two held points leave the rotation about their line open; far from the origin, translations
    and rotations of them are nearly the same."""
    random = np.random.default_rng(0)
    X, free = 50 * random.normal(size=(6, 3)) + offset, np.ones((6, 3))
    free[:2] = 0
    i, j = np.triu_indices(6, 1)
    measured = np.linalg.norm(X[j] - X[i], axis=1)
    distance = ls.Kind(
        "distance", lambda a, b, d: jnp.linalg.norm(b - a) - d, of=("point", "point")
    )
    problem = ls.make_problem(
        [ls.Table("point", X, free=free)],
        [distance(rows=(i, j), measured=measured, sigma=0.01)],
        motions=ls.similarity(["point"]),
        datum=lambda gauge: ({"point": free}, False),
    )
    start = complete_data(problem, problem.data).start["point"]
    moved = {"point": start.at[:2].add(0.1 * random.normal(size=(2, 3)))}
    gauge = keep_held_fixed(problem.declared, problem.plan, moved).datum.gauge
    motion = np.asarray(generators(problem.declared, moved)["point"] @ gauge)
    assert gauge.shape[1] == 1
    assert np.abs(motion[:2]).max() < 1e-6 * np.abs(motion[2:6]).max()
