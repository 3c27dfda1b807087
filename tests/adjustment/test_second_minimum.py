"""Second minima: compared with dense adjustments from the other pose, taken, or left alone."""

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import jaxbundle
from jaxbundle.adjustment.second_minima.closed_forms import (
    ImageRays,
    NetworkScene,
    mirror,
    perspective_effect,
    reverse_depth,
    turn_over,
)
from jaxbundle.adjustment.second_minima.evidence import (
    MIRRORED,
    OTHER_PLANE,
    REVERSED,
    SECOND_MINIMUM,
    TURNED,
    evidence,
)
from jaxbundle.geometry import omega_phi_kappa_from_matrix
from jaxbundle.network import Camera, Images, Network, Observations, Points
from jaxbundle.report.page import compose

PROJECT = Path(__file__).parents[2] / "examples" / "convergent4" / "project.toml"
C = 50.0
FAR, NEAR = 2000.0, 5.0
"""Distances of an object of 2: perspective is 1/1000 of its image, and as large as it."""


def image_points(X0, M, X):
    d = np.einsum("kij,knj->kni", M, X - X0[:, None])
    return -C * d[..., :2] / d[..., 2:]


def pose(tilt, azimuth, distance, roll=0.4):
    """A camera that looks at the origin."""
    tilt, azimuth = np.deg2rad([tilt, azimuth])
    z = np.array([np.sin(tilt) * np.cos(azimuth), np.sin(tilt) * np.sin(azimuth), np.cos(tilt)])
    x = np.cross([0.3, 1.0, 0.1], z)
    x /= np.linalg.norm(x)
    M = Rotation.from_euler("z", roll).as_matrix() @ np.stack([x, np.cross(z, x), z])
    return distance * z, M


def poses(directions, distance):
    X0, M = zip(*(pose(*d, distance, 0.7 * k) for k, d in enumerate(directions)))
    return np.stack(X0), np.stack(M)


def network(X, xy, sigma, X0, M, role="fixed"):
    images, n = xy.shape[:2]
    role = (role,) * n if isinstance(role, str) else tuple(role)
    angles = np.stack([np.asarray(omega_phi_kappa_from_matrix(m)) for m in M])
    return Network(
        name="second minimum",
        cameras=(Camera("cam", "brown", {"c": C}, ()),),
        images=Images(
            tuple(f"i{k}" for k in range(images)), np.zeros(images, int), X0, angles,
            np.full((images, 6), np.nan),
        ),
        points=Points(tuple(f"p{k}" for k in range(n)), role, X, np.full((n, 3), np.nan)),
        observations=Observations(
            np.repeat(np.arange(images), n), np.tile(np.arange(n), images), xy.reshape(-1, 2),
            np.full((images * n, 2), sigma),
        ),
        datum="inner" if "fixed" not in role else "control",
    )  # fmt: skip


def board():
    side = np.linspace(-1, 1, 4)
    return np.array([(x, y, 0.0) for x in side for y in side])


def image_of_board(distance, sigma, start=None, seed=0, tilt=40):
    """A board in one image, the start values true or given."""
    X0, M = poses([(tilt, 25)], distance)
    noise = sigma * np.random.default_rng(seed).normal(size=(1, 16, 2))
    return network(board(), image_points(X0, M, board()) + noise, sigma, *(start or (X0, M)))


def other_pose(distance, tilt=40):
    """The tilt in the opposite direction: half a turn about the line of sight and about the
    normal."""
    X0, M = poses([(tilt, 25)], distance)
    sight = M[0] @ X0[0] / distance
    half_turn = lambda a: 2 * np.outer(a, a) - np.eye(3)
    M = (half_turn(sight) @ M[0] @ half_turn(np.array([0, 0, 1.0])))[None]
    return np.einsum("kji,j->ki", M, distance * sight), M


def dense_vtpv(given, X0, M, free_points=False):
    """vᵀPv of a network at the minimum that a dense Levenberg-Marquardt with derivatives by
    differences reaches from these poses, and from its points."""
    images, n = len(X0), len(given.points)
    xy, sigma = given.observations.xy.reshape(images, n, 2), given.observations.sigma[0, 0]
    size = np.linalg.norm(X0[0])

    def residuals(p):
        X = given.points.position + (p[6 * images :].reshape(n, 3) if free_points else 0)
        turn = Rotation.from_rotvec(p[3 * images : 6 * images].reshape(-1, 3)).as_matrix()
        centre = X0 + size * p[: 3 * images].reshape(-1, 3)
        return ((image_points(centre, turn @ M, X) - xy) / sigma).ravel()

    p = np.zeros(6 * images + (3 * n if free_points else 0))
    r, damping, h = residuals(p), 1e-4, 1e-6
    for _ in range(150):
        J = np.stack(
            [(residuals(p + h * e) - residuals(p - h * e)) / (2 * h) for e in np.eye(len(p))], 1
        )
        N = J.T @ J
        D = np.diag(np.diag(N)) + 1e-9 * np.eye(len(p))
        for _ in range(20):
            step = -np.linalg.solve(N + damping * D, J.T @ r)
            trial = residuals(p + step)
            if trial @ trial <= r @ r:
                break
            damping *= 4
        gain = r @ r - trial @ trial
        p, r, damping = p + step, trial, damping / 5
        if abs(gain) < 1e-11 * (1 + r @ r):
            break
    return r @ r


# --- closed forms ---------------------------------------------------------------------------------


def test_the_second_solutions_are_those_of_parallel_projection():
    rng = np.random.default_rng(1)
    X = rng.normal(size=(12, 3))
    flat = X * [1, 1, 0]
    rays = ImageRays(np.repeat(np.arange(3), 12), np.tile(np.arange(12), 3), np.full(36, 1e-3))
    for distance, error in ((1e3, 1e-5), (1e5, 1e-9)):
        X0, M = poses([(30, 10), (50, 200), (20, 90)], distance)
        for given, solve in ((flat, turn_over), (X, reverse_depth)):
            scene = NetworkScene(X0, M, given)
            other = solve(scene, rays)
            # (x/c)·(z/distance): second order in the size of the object over the distance
            off = image_points(other.X0, other.M, other.X) - image_points(X0, M, given)
            assert 0 < np.abs(off).max() < 20 * C * error
            np.testing.assert_allclose(np.linalg.det(other.M), 1)
            assert (perspective_effect(scene, other, rays) > 0).all()


def test_the_mirrored_network_fits_exactly_from_below():
    X0, M = poses([(30, 10), (50, 200)], 4.0)
    X = np.random.default_rng(2).normal(size=(10, 3)) * [1, 1, 0.3]
    known = np.arange(10) < 4
    X[known, 2] = 0.0
    other = mirror(NetworkScene(X0, M, X), known)
    np.testing.assert_allclose(other.X, X * [1, 1, -1], atol=1e-12)
    np.testing.assert_allclose(other.X0, X0 * [1, 1, -1], atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(other.M), 1)
    seen = image_points(other.X0, other.M, other.X)
    np.testing.assert_allclose(seen, image_points(X0, M, X), atol=1e-11)


def test_the_threshold_is_that_of_the_likelihood_ratio():
    """Of two normal hypotheses that differ by d the false one has E below −T, for the true one,
    with a probability of at most α, whatever d; and `limit` of d² keeps E above T as often."""
    rng, settings = np.random.default_rng(0), SECOND_MINIMUM
    z = rng.normal(size=1_000_000)
    for d in (1.0, 3.0, np.sqrt(settings.threshold), 6.0):
        assert (d * d + 2 * d * z < -settings.threshold).mean() <= settings.error_probability
    d = np.sqrt(settings.limit)
    below = (d * d + 2 * d * z < settings.threshold).mean()
    assert below == pytest.approx(settings.error_probability, rel=0.15)
    assert evidence(20.0, 26.0, 20, True, 0.0) == 6.0
    assert evidence(80.0, 86.0, 20, True, 0.0) == 1.5  # σ0² = 4
    assert evidence(5.0, 11.0, 20, True, 0.0) == 6.0  # residuals below their σ are chance
    assert evidence(5.0, 11.0, 20, False, 0.0) == pytest.approx(20 * np.log(11 / 5))
    assert evidence(1e-20, 2e-20, 20, False, 1e-15) == 0.0


# --- one image ------------------------------------------------------------------------------------


@pytest.mark.further
@pytest.mark.parametrize("start", ["true", "other"])
def test_a_board_seen_from_afar_has_both_solutions(start):
    sigma = 1e-4  # E of about 6
    begin = other_pose(FAR) if start == "other" else None
    given = image_of_board(FAR, sigma, begin)
    result = jaxbundle.adjust(given)
    true = dense_vtpv(given, *poses([(40, 25)], FAR))
    other = dense_vtpv(given, *other_pose(FAR))
    (found,) = result.second_minima
    assert result.vtpv == pytest.approx(min(true, other), rel=1e-7)
    assert found.difference == pytest.approx(abs(other - true), abs=1e-6)
    assert 0.1 < found.difference < SECOND_MINIMUM.threshold
    assert (found.ambiguity, found.images) == (TURNED, ("i0",))
    assert found.ambiguous and found.taken == (start == "other")
    assert np.rad2deg(found.turn) == pytest.approx(80, abs=2)
    assert found.probability == pytest.approx(1 / (1 + np.exp(found.difference / 2)))
    alone = jaxbundle.adjust(given, second_minimum=False)
    assert not alone.second_minima
    assert alone.vtpv == pytest.approx(true if start == "true" else other, rel=1e-7)


def test_it_is_said_everywhere_and_kept(tmp_path):
    result = jaxbundle.adjust(image_of_board(FAR, 1e-4))
    (found,) = result.second_minima
    assert result.verdict.state == "doubtful"
    assert "second solution fits as well" in result.verdict.words
    (finding,) = (f for f in result.verdict.findings if f.about == "Second minimum")
    assert f"{found.vtpv:.6g}" in finding.words and f"{found.other_vtpv:.6g}" in finding.words
    flat = " ".join(result.report().split())
    assert "planar object turned over" in flat and f"{found.other_vtpv:.6g}" in flat
    assert "Second minimum" in "".join(compose(result))
    (said,) = json.loads(json.dumps(result.to_dict(brief=True)))["second_minima"]
    assert said["difference"] == found.difference and said["images"] == ["i0"]
    assert said["ambiguous"] and not said["taken"]
    result.save(tmp_path / "result.jbr")
    kept = jaxbundle.load_adjustment(tmp_path / "result.jbr")
    assert kept.second_minima == result.second_minima


def test_strong_perspective_has_no_second_solution():
    for tilt in (5, 40, 70):
        result = jaxbundle.adjust(image_of_board(NEAR, 1e-3, tilt=tilt))
        assert result.converged and not result.second_minima
        assert all(f.about != "Second minimum" for f in result.verdict.findings)


def test_the_better_one_is_taken_from_the_wrong_minimum():
    given = image_of_board(60.0, 1e-3, other_pose(60.0))
    wrong = jaxbundle.adjust(given, second_minimum=False)
    result, right = jaxbundle.adjust(given), jaxbundle.adjust(image_of_board(60.0, 1e-3))
    assert wrong.vtpv > right.vtpv + 100
    assert result.vtpv == pytest.approx(right.vtpv, rel=1e-9)
    np.testing.assert_allclose(result.images["X0"], right.images["X0"], rtol=1e-7)
    np.testing.assert_allclose(result.images["sX0"], right.images["sX0"], rtol=1e-5)
    (found,) = result.second_minima
    assert found.taken and not found.ambiguous
    assert found.other_vtpv == pytest.approx(wrong.vtpv, rel=1e-9)
    assert "the better one is taken" in found.in_words("m")
    assert not right.second_minima
    # a good result: noted, and not doubtful because of it
    (finding,) = (f for f in result.verdict.findings if f.about == "Second minimum")
    assert finding.state == "noted"


def test_blunders_are_looked_for_in_the_better_minimum():
    given = image_of_board(60.0, 1e-3, other_pose(60.0))
    xy = given.observations.xy.copy()
    xy[5] += [0.05, 0.0]
    given = given.replace(observations=dataclasses.replace(given.observations, xy=xy))
    result = jaxbundle.adjust(given, snooping="pope")
    assert ["p5" in str(r.name) for r in result.removed] == [True]
    assert [one.taken for one in result.second_minima] == [True]
    alone = jaxbundle.adjust(given, snooping="pope", second_minimum=False)
    assert not any("p5" in str(r.name) for r in alone.removed) or len(alone.removed) > 1


def test_sigma_as_a_unit_of_weight_changes_no_decision():
    """Residuals a hundred times their unit of weight: E follows their own size."""
    given = image_of_board(FAR, 1e-4)
    rays = dataclasses.replace(
        given.observations, sigma=given.observations.sigma / 100, sigma_origin="unit"
    )
    (stated,) = jaxbundle.adjust(given).second_minima
    (found,) = jaxbundle.adjust(given.replace(observations=rays)).second_minima
    assert found.difference == pytest.approx(1e4 * stated.difference, rel=1e-6)
    r = 26
    assert found.evidence == pytest.approx(r * np.log(stated.other_vtpv / stated.vtpv), rel=1e-6)
    assert found.ambiguous


# --- several images -------------------------------------------------------------------------------

DIRECTIONS = ((30, 0), (35, 75), (25, 150), (40, 220), (30, 300))


def test_cameras_under_the_floor_come_up():
    """Control on the floor, the start values mirrored: the same residuals, but the images look away
    from their points."""
    rng = np.random.default_rng(3)
    X = np.concatenate([board(), rng.uniform(-1, 1, (8, 3)) + [0, 0, 1.5]])
    X0, M = poses(DIRECTIONS[:3], 6.0)
    xy = image_points(X0, M, X) + 1e-3 * rng.normal(size=(3, 24, 2))
    role = ["fixed"] * 16 + ["tie"] * 8
    right = jaxbundle.adjust(network(X, xy, 1e-3, X0, M, role))
    below = mirror(NetworkScene(X0, M, X), np.arange(24) < 16)
    given = network(below.X, xy, 1e-3, below.X0, below.M, role)
    wrong = jaxbundle.adjust(given, second_minimum=False)
    assert (wrong.images["Z0"] < 0).all()
    assert wrong.vtpv == pytest.approx(right.vtpv, rel=1e-9)
    result = jaxbundle.adjust(given)
    np.testing.assert_allclose(result.images["Z0"], right.images["Z0"], rtol=1e-9)
    np.testing.assert_allclose(result.points["Z"], right.points["Z"], atol=1e-8)
    (found,) = result.second_minima
    assert found.ambiguity == MIRRORED and found.taken and not found.ambiguous
    assert not right.second_minima


def test_a_free_network_from_afar_has_its_reversal():
    rng = np.random.default_rng(4)
    X = rng.uniform(-1, 1, (20, 3))
    X0, M = poses(DIRECTIONS, FAR)
    sigma = 2e-5 * FAR / 1000
    xy = image_points(X0, M, X) + sigma * rng.normal(size=(5, 20, 2))
    given = network(X, xy, sigma, X0, M, "tie")
    result = jaxbundle.adjust(given)
    (found,) = (one for one in result.second_minima if one.ambiguity == REVERSED)
    rays = ImageRays(np.repeat(np.arange(5), 20), np.tile(np.arange(20), 5), np.full(100, 1e-3))
    other = reverse_depth(NetworkScene(X0, M, X), rays)
    turned = given.replace(points=dataclasses.replace(given.points, position=other.X))
    true = dense_vtpv(given, X0, M, free_points=True)
    reversed_ = dense_vtpv(turned, other.X0, other.M, free_points=True)
    assert found.difference == pytest.approx(abs(reversed_ - true), abs=1e-4)
    assert result.vtpv == pytest.approx(min(true, reversed_), rel=1e-6)


def views_of_a_board(distance, sigma, turned=()):
    """Twelve views, some of which start from the turned pose."""
    rng = np.random.default_rng(5)
    X0, M = poses(zip(rng.uniform(15, 55, 12), rng.uniform(0, 360, 12)), distance)
    X0 *= rng.uniform(0.9, 1.2, (12, 1))
    xy = image_points(X0, M, board()) + sigma * rng.normal(size=(12, 16, 2))
    rays = ImageRays(np.repeat(np.arange(12), 16), np.tile(np.arange(16), 12), np.ones(192))
    other = turn_over(NetworkScene(X0, M, board()), rays)
    rows = list(turned)
    X0[rows], M[rows] = other.X0[rows], other.M[rows]
    return network(board(), xy, sigma, X0, M)


@pytest.mark.further
def test_views_of_a_calibration_are_turned_back():
    camera = Camera("cam", "brown", {"c": C}, ("c", "K1"))
    right, given = (
        views_of_a_board(60.0, 1e-3, turned).replace(cameras=(camera,)) for turned in ((), (2, 7))
    )
    result = jaxbundle.adjust(given)
    assert result.vtpv == pytest.approx(jaxbundle.adjust(right).vtpv, rel=1e-8)
    (found,) = result.second_minima
    assert found.images == ("i2", "i7") and found.taken and not found.ambiguous


@pytest.mark.further
def test_many_ambiguous_views_have_the_best_of_their_poses():
    """Images that share nothing: every one in its better pose, from either start."""
    results = [jaxbundle.adjust(views_of_a_board(400.0, 2e-3, rows)) for rows in ((), range(12))]

    def vtpv_alone(k, rows):
        given = views_of_a_board(400.0, 2e-3, rows)
        rays = given.observations.take(given.observations.image == k)
        alone = given.replace(
            images=given.images.take(np.arange(12) == k),
            observations=dataclasses.replace(rays, image=np.zeros(16, int)),
        )
        return jaxbundle.adjust(alone, second_minimum=False).vtpv

    best = sum(min(vtpv_alone(k, rows) for rows in ((), (k,))) for k in range(12))
    for result in results:
        assert result.vtpv == pytest.approx(best, rel=1e-7)
        assert len([one for one in result.second_minima if one.ambiguity == TURNED]) >= 8
        assert any("further image" in note for note in result.notes)


def test_two_images_of_a_plane_have_two_orientations():
    rng = np.random.default_rng(3)
    X = np.concatenate([rng.uniform(-2, 2, (20, 2)), np.zeros((20, 1))], 1)
    X0, M = pose(45, 200, 8.0, 0.3)
    # towards an oblique plane: the other plane is across the base, in front of both
    X0 = np.stack([X0, 0.85 * X0 + [0.1, -0.2, 0.15]])
    M = np.stack([M, Rotation.from_rotvec([0.03, -0.05, 0.04]).as_matrix() @ M])
    xy = image_points(X0, M, X) + 5e-3 * rng.normal(size=(2, 20, 2))
    result = jaxbundle.adjust(network(X, xy, 5e-3, X0, M, "tie"))
    (found,) = result.second_minima
    assert found.ambiguity == OTHER_PLANE and found.ambiguous
    # a third image decides
    third = poses([(30, 100)], 8.0)
    X0, M = np.concatenate([X0, third[0]]), np.concatenate([M, third[1]])
    xy = image_points(X0, M, X) + 5e-3 * rng.normal(size=(3, 20, 2))
    assert not jaxbundle.adjust(network(X, xy, 5e-3, X0, M, "tie")).second_minima


def test_an_ordinary_network_is_adjusted_as_without():
    given = jaxbundle.read_network(PROJECT)
    one, two = jaxbundle.adjust(given), jaxbundle.adjust(given, second_minimum=False)
    assert not one.second_minima
    assert one.vtpv == two.vtpv and one.iterations == two.iterations
    with pytest.raises(jaxbundle.InputError, match="second_minimum"):
        jaxbundle.adjust(given, second_minimum="yes")
