"""Problems that are no networks, in a few lines each: a trilateration with blunders and a free
datum, the hand-eye calibration of a robot."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxbundle import InputError, NotSolvedError
from jaxbundle import leastsquares as ls
from jaxbundle.geometry import quaternion_from_rotation_vector
from jaxbundle.leastsquares.quality.null_space import undetermined_eliminated_unknowns

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


@pytest.mark.further
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
    named = undetermined_eliminated_unknowns(unseen.problem, unseen.minimum.values)
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


@pytest.mark.further
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


def test_an_angle_of_180_degrees_is_named():
    """Its sine is the root of a square, which has no derivative where the points are in line."""

    def residual(a, at, b, measured):
        u, v = a - at, b - at
        sine = jnp.sqrt(jnp.sum(jnp.cross(u, v) ** 2))
        return jnp.arctan2(sine, u @ v) - measured

    X = np.array([[0.0, 0, 0], [1, 0, 0], [2, 0, 0]])
    angle = ls.Kind("angle", residual, of=("point",) * 3)
    place = ls.Kind("place", lambda x, measured: x - measured, of=("point",))
    observations = [angle(([0], [1], [2]), np.array([np.pi])), place((np.arange(3),), X)]
    result = ls.adjust([ls.Table("point", X)], observations)
    assert not result.converged
    name = "no finite residual or derivative of: angle of point 1 and point 2 and point 3"
    assert str(result).endswith(name)
    with pytest.raises(NotSolvedError, match=name):
        result["point"]


def line(n=12):
    """Numbers on a line y = a + b·t of one row [2], exact."""
    t = np.linspace(-1, 1, n)
    kind = ls.Kind("reading", lambda x, m: x[0] + x[1] * m[0] - m[1], of=("line",), axes=("y",))
    return kind, np.zeros(n, int), t, 3.0 + 2.0 * t


def test_an_exact_fit_is_a_solution_whatever_is_measured_with_it():
    """Its residuals are rounding; that no step reduces them further is not a singularity."""
    kind, row, t, y = line()
    result = ls.adjust([ls.Table("line", np.zeros((1, 2)))], [kind((row,), (t, y))])
    assert result.converged, result.termination
    np.testing.assert_allclose(result["line"].value, [[3.0, 2.0]], atol=1e-12)


def test_measured_arrays_of_different_shapes():
    random = np.random.default_rng(0)
    a, s, x = random.normal(size=(20, 3)), random.uniform(1, 2, 20), np.array([1.0, 2.0, 3.0])
    kind = ls.Kind("scaled", lambda x, m: m[1] * (m[0] @ x) - m[2], of=("x",))
    measured = a, s, s * (a @ x) + 1e-3 * random.normal(size=20)
    result = ls.adjust([ls.Table("x", np.zeros((1, 3)))], [kind((np.zeros(20, int),), measured)])
    right = np.linalg.lstsq(s[:, None] * a, measured[2], rcond=None)[0]
    np.testing.assert_allclose(result["x"].value, [right], atol=1e-9)


@pytest.mark.parametrize("eliminate", ["line", None])
def test_sets_without_observations(eliminate):
    """They change nothing, whatever is asked of the result."""
    kind, row, t, y = line()
    y = y + 0.01 * np.random.default_rng(2).normal(size=len(y))
    y[4] += 1.0
    table, seen = ls.Table("line", np.zeros((1, 2))), kind((row,), (t, y), sigma=0.01)
    other = ls.Kind("other", lambda x, d: x - d, of=("line",))
    none = other((np.zeros(0, int),), np.zeros((0, 2)), sigma=0.1)
    also = other((np.zeros(0, int),), np.zeros((0, 2)), covariance=np.zeros((0, 2, 2)))
    for options in ({"snooping": "pope"}, {"robust": "tukey"}, {"estimate_components": True}):
        alone = ls.adjust([table], [seen], eliminate=eliminate, **options)
        result = ls.adjust([table], [none, seen, also], eliminate=eliminate, **options)
        assert result.counts == alone.counts
        np.testing.assert_allclose(result["line"].value, alone["line"].value, atol=1e-12)
        assert result.removed == alone.removed
    assert result.residuals("other")["v"].shape == (0, 2)


def test_observations_of_held_rows_determine_nothing_of_a_free_datum():
    fixed = ls.Table("fixed", np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 2]]), free=False)
    new = ls.Table("new", np.array([[0.5, 0.5, 0.5]]))
    of = lambda *tables: ls.Kind(" to ".join(tables), RANGE.residual, of=tables)
    seen = of("fixed", "new")((np.arange(4), np.zeros(4, int)), [0.87, 0.86, 0.87, 1.66])
    between = of("fixed", "fixed")(([0], [1]), [1.002], sigma=0.01)
    alone = ls.adjust([fixed, new], [seen], datum="inner")
    both = ls.adjust([fixed, new], [seen, between], datum="inner")
    np.testing.assert_allclose(both["new"].value, alone["new"].value, atol=1e-9)
    assert both.counts.datum == 0 and both.counts.redundancy == alone.counts.redundancy + 1


def test_robust_estimation_without_anything_to_weight_is_refused():
    kind, row, t, y = line()
    single = dataclasses.replace(kind, snooped="single")
    with pytest.raises(InputError, match="no kind of observation is weighted as a whole"):
        ls.adjust([ls.Table("line", np.zeros((1, 2)))], [single((row,), (t, y))], robust="huber")


PAIR = ls.Kind("pair", lambda x, m: m["t"] @ x - m["y"], of=("x",), snooped="single")


@pytest.fixture
def pairs():
    """Pairs with a correlation of 0.9, σ 0.01, of six rows; their design [n, 2, 12]."""
    random, n, rows = np.random.default_rng(1), 40, 6
    t, x = random.normal(size=(n, 2, 2)), random.normal(size=(rows, 2))
    i = random.integers(0, rows, n)
    C = 1e-4 * np.array([[1.0, 0.9], [0.9, 1.0]])
    y = np.einsum("nij,nj->ni", t, x[i]) + random.multivariate_normal([0, 0], C, n)
    A = np.zeros((n, 2, rows, 2))
    A[np.arange(n), :, i] = t
    return t, y, i, C, A.reshape(n, 2, -1)


@pytest.mark.parametrize("wrong", [[(0, 0.2)], [(1, 0.2)], [(0, 0.2), (1, 0.5)]])
def test_a_blunder_of_one_of_two_correlated_residuals(pairs, wrong):
    """It alone is removed; the other keeps its own variance (Baarda's test of correlated
    observations; the solution by dense algebra without it)."""
    t, y, i, C, A = pairs
    y = y.copy()
    for residual, error in wrong:
        y[3, residual] += error
    seen = PAIR((i,), {"t": t, "y": y}, covariance=np.tile(C, (len(i), 1, 1)))
    result = ls.adjust([ls.Table("x", np.zeros((6, 2)))], [seen], snooping="baarda")
    found = {(r.row, r.residual) for r in result.removed}
    assert found == {(3, residual) for residual, _ in wrong}
    P = np.tile(np.linalg.inv(C), (len(i), 1, 1))
    P[3] = np.diag([0.0 if (3, k) in found else 1 / C[k, k] for k in range(2)])
    N = np.einsum("nia,nij,njb->ab", A, P, A)
    x = np.linalg.solve(N, np.einsum("nia,nij,nj->a", A, P, y))
    np.testing.assert_allclose(result["x"].value.ravel(), x, atol=1e-10)
    sigma = np.sqrt(np.diag(np.linalg.inv(N)))
    np.testing.assert_allclose(result["x"].sigma.ravel() / result.sigma0, sigma, rtol=1e-9)
    v, s = result.residuals("pair")["v"][3], result.residuals("pair")["sigma"][3]
    removed = [k for k, _ in wrong]
    assert np.isnan(v[removed]).all() and np.isinf(s[removed]).all()
    kept = [k for k in range(2) if k not in removed]
    np.testing.assert_allclose(v[kept], (A[3] @ x - y[3])[kept], atol=1e-10)
    np.testing.assert_allclose(s[kept], 0.01)
