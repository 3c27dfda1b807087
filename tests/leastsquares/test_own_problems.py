"""Problems that are no networks, in a few lines each: a trilateration with blunders and a free
datum, the hand-eye calibration of a robot."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxbundle import NotSolvedError
from jaxbundle import leastsquares as ls
from jaxbundle.geometry import quaternion_from_rotation_vector
from jaxbundle.leastsquares.quality.names import undetermined_rows

SIGMA = 0.002
RANGE = ls.Kind("distance", lambda a, b, d: jnp.linalg.norm(a - b) - d, of=("point", "point"))


def places(random):
    return random.uniform(-10, 10, (12, 3))


def distances(random, points):
    i, j = np.triu_indices(len(points), 1)
    true = np.linalg.norm(points[i] - points[j], axis=1)
    return i, j, true + SIGMA * random.normal(size=len(i))


@pytest.fixture(scope="module")
def trilateration():
    random = np.random.default_rng(1)
    points = places(random)
    i, j, measured = distances(random, points)
    start = points + random.normal(scale=0.3, size=points.shape)
    return points, start, (i, j), measured


def test_free_trilateration_against_dense_algebra(trilateration):
    points, start, rows, measured = trilateration
    result = ls.adjust(
        [ls.Table("point", start)], [RANGE(rows, measured, sigma=SIGMA)], datum="inner",
        motions=ls.similarity(["point"]),
    )  # fmt: skip
    assert result.converged
    assert result.counts.datum == 6  # distances give the scale
    assert result.counts.redundancy == 66 + 6 - 36
    assert 0.7 < result.sigma0 < 1.3
    X, (i, j) = result["point"].value, rows
    unit = (X[i] - X[j]) / np.linalg.norm(X[i] - X[j], axis=1)[:, None]
    J = np.zeros((len(i), 12, 3))
    J[np.arange(len(i)), i], J[np.arange(len(i)), j] = unit, -unit
    J = J.reshape(len(i), -1) / SIGMA
    Q = np.linalg.pinv(J.T @ J, rcond=1e-9)
    np.testing.assert_allclose(
        result["point"].sigma.ravel(), result.sigma0 * np.sqrt(np.diag(Q)), rtol=1e-6
    )
    r = result.redundancy("distance")
    np.testing.assert_allclose(r, 1 - np.einsum("ni,ij,nj->n", J, Q, J), atol=1e-8)
    # Inner constraints: no shift and no rotation against the start values.
    assert np.abs((X - start).sum(0)).max() < 1e-9
    assert np.abs(np.cross(start, X - start).sum(0)).max() < 1e-6


def test_blunders_of_a_trilateration_are_removed(trilateration):
    points, start, rows, measured = trilateration
    wrong = measured.copy()
    wrong[[7, 40]] += [0.5, -0.05]
    result = ls.adjust(
        [ls.Table("point", start)], [RANGE(rows, wrong, sigma=SIGMA)], datum="inner",
        motions=ls.similarity(["point"]), snooping="pope",
    )  # fmt: skip
    assert {r.row for r in result.removed} == {7, 40}
    robust = ls.adjust(
        [ls.Table("point", start)], [RANGE(rows, wrong, sigma=SIGMA)], datum="inner",
        motions=ls.similarity(["point"]), robust="tukey",
    )  # fmt: skip
    assert {s.row for s in robust.suspects} == {7, 40}


def test_a_row_that_loses_its_only_view_is_excluded():
    """Of three views of a point, the wrong one is the only one with its height."""
    random = np.random.default_rng(3)
    points = places(random)
    number, lost = len(points), 4
    plan, side = np.eye(3)[[0, 1]], np.eye(3)[[0, 2]]
    view = ls.Kind("view", lambda p, s, d: d["M"] @ p + d["t"] * s - d["y"], of=("point", "shift"))
    point = np.concatenate([np.repeat(np.arange(number), 3), np.delete(np.arange(number), lost)])
    last = np.arange(len(point)) >= 3 * number
    M = np.where(((np.arange(len(point)) % 3 == 2) | last)[:, None, None], side, plan)
    t = last[:, None] * np.array([0.0, 1.0])
    y = np.einsum("nij,nj->ni", M, points[point]) + 0.7 * t
    y += SIGMA * random.normal(size=y.shape)
    y[3 * lost + 2, 0] += 1.0

    def adjusted(rows, **options):
        return ls.adjust(
            [ls.Table("point", np.zeros((number, 3))), ls.Table("shift", np.zeros(1))],
            [view((point[rows], np.zeros(rows.sum(), int)),
                  {"M": M[rows], "t": t[rows], "y": y[rows]}, sigma=SIGMA)],
            eliminate="point", **options,
        )  # fmt: skip

    unseen = adjusted(np.arange(len(point)) != 3 * lost + 2)
    named = undetermined_rows(unseen.problem, unseen.minimum.values)
    assert named == ["1, 2, 3 of point 5"] and named == [*unseen.undetermined]
    result = adjusted(np.ones(len(point), bool), snooping="pope")
    assert result.converged and [r.row for r in result.removed] == [3 * lost + 2]
    others = np.delete(np.arange(number), lost)
    assert np.abs(result["point"].value - points)[others].max() < 5 * SIGMA
    assert result["shift"].value == pytest.approx(0.7, abs=4 * SIGMA / 3)
    assert result.counts.redundancy == 2 * (len(point) - 3) - 3 * (number - 1) - 1


def test_sigma_of_components(trilateration):
    _, start, rows, measured = trilateration
    result = ls.adjust(
        [ls.Table("point", start)], [RANGE(rows, measured, sigma=10 * SIGMA)], datum="minimal",
        motions=ls.similarity(["point"]), estimate_components=True,
    )  # fmt: skip
    assert result.sigma0 == pytest.approx(1, abs=1e-3)
    assert result.sigma_factors["distance"] == pytest.approx(0.1, rel=0.4)


def test_what_nothing_determines_is_named(trilateration):
    _, start, (i, j), measured = trilateration
    lonely = np.concatenate([start, [[50.0, 0, 0]]])
    rows, measured = (np.append(i, 0), np.append(j, 12)), np.append(measured, 50.0)
    result = ls.adjust(
        [ls.Table("point", lonely)], [RANGE(rows, measured, sigma=SIGMA)], datum="inner",
        motions=ls.similarity(["point"]),
    )  # fmt: skip
    assert not result.converged
    assert any("of point 13" in name for name in result.undetermined)
    with pytest.raises(NotSolvedError, match="of point 13"):
        result.residuals("distance")


def test_hand_eye_calibration_of_a_robot():
    """A = gripper in the base (known), X = camera in the gripper, Z = base in the board: the camera
    has measured poses B of the board with M_B = M_X·M_A·M_Zᵀ and the like for the centre."""
    random = np.random.default_rng(3)
    n, place = 15, 1e-3
    vectors = jnp.asarray(random.normal(size=(n, 3)))
    turns = np.asarray(jax.vmap(quaternion_from_rotation_vector)(vectors))
    gripper = ls.PoseValue(random.uniform(-1, 1, (n, 3)), turns)
    one = lambda p, v: ls.PoseValue(
        np.array([p]), np.asarray(quaternion_from_rotation_vector(jnp.asarray(v)))[None]
    )
    truth = one([0.1, -0.05, 0.2], [0.3, -0.2, 0.5]), one([1.0, 0.4, -0.3], [-0.4, 1.0, 0.2])
    corners = np.array([[0, 0, 0], [0.3, 0, 0], [0, 0.2, 0], [0.3, 0.2, 0.05]])
    kind = ls.Kind(
        "corner", lambda camera, base, hand, corner, seen: (
            jnp.stack(camera.ray(hand.ray(base.place(corner)))) - seen
        ), of=("camera in gripper", "base in board", "gripper", "corner"),
        axes=("x", "y", "z"),
    )  # fmt: skip
    space = ls.Pose()
    blocks = [space.prepare(jax.tree.map(lambda x: jnp.asarray(x[0]), t)) for t in truth]
    i, c = (k.ravel() for k in np.indices((n, 4)))
    seen = []
    for k, corner in zip(i, corners[c]):
        hand = space.prepare(jax.tree.map(lambda x, k=k: jnp.asarray(x[k]), gripper))
        seen.append(jnp.stack(blocks[0].ray(hand.ray(blocks[1].place(tuple(corner))))))
    seen = np.array(seen) + place * random.normal(size=(len(i), 3))
    zero = np.zeros(len(i), int)
    result = ls.adjust(
        [
            ls.Table("camera in gripper", one([0.0, 0, 0], [0.2, -0.1, 0.4])),
            ls.Table("base in board", one([0.8, 0.3, -0.2], [-0.3, 0.9, 0.1])),
            ls.Table("gripper", gripper, free=False),
            ls.Table("corner", corners, free=False),
        ],
        [kind((zero, zero, i, c), seen, sigma=place)],
    )
    assert result.converged and 0.8 < result.sigma0 < 1.2
    for name, true in zip(("camera in gripper", "base in board"), truth):
        found = result[name]
        change = np.asarray(space.difference(
            jax.tree.map(lambda x: jnp.asarray(x[0]), found.value),
            jax.tree.map(lambda x: jnp.asarray(x[0]), true),
        ))  # fmt: skip
        assert (np.abs(change) < 4 * found.sigma[0]).all()
        assert (found.sigma[0] > 0).all() and (found.sigma[0] < 10 * place).all()


def test_tables_that_share_a_block_and_an_observation_of_the_first_and_last():
    """Three tables whose rows always meet a point together are one block row; what touches only the
    first and the last has no derivative by the one between."""
    random = np.random.default_rng(3)
    sets, points = 4, 20
    of, point = np.repeat(np.arange(sets), points), np.tile(np.arange(points), sets)
    seen = ls.Kind("seen", lambda a, b, c, x, d: a + b * d[0] + c * d[0] ** 2 + x - d[1],
                   of=("a", "b", "c", "x"))  # fmt: skip
    both = ls.Kind("sum", lambda a, c, d: a + 2 * c - d, of=("a", "c"))
    size = random.normal(size=len(of))
    measured = np.stack([size, random.normal(size=len(of))], 1)
    tables = [ls.Table(name, np.zeros(n)) for name, n in zip("abcx", (sets,) * 3 + (points,))]
    observations = [
        seen((of, of, of, point), measured), both((np.arange(sets),) * 2, random.normal(size=sets)),
    ]  # fmt: skip
    rows = len(of) + sets
    A = np.zeros((rows, 3 * sets + points))
    every, own = np.arange(len(of)), np.arange(sets)
    for k in range(3):
        A[every, k * sets + of] = size**k
    A[every, 3 * sets + point] = 1
    A[len(of) + own, own], A[len(of) + own, 2 * sets + own] = 1, 2
    x = np.linalg.lstsq(A, np.r_[measured[:, 1], observations[1].measured], rcond=None)[0]
    result = ls.adjust(tables, observations, eliminate="x")
    found = np.concatenate([result[name].value for name in "abcx"])
    np.testing.assert_allclose(found, x, atol=1e-9)
