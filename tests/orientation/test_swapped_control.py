"""Which names of points are exchanged, from two lists of them in different frames."""

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest

import jaxbundle
from jaxbundle import Camera
from jaxbundle.errors import NotSolvedError
from jaxbundle.network.tables import Points
from jaxbundle.orientation import alignment, batched
from jaxbundle.orientation.alignment import similarity, similarity_of_most
from jaxbundle.orientation.swapped_control import contradiction

RNG = np.random.default_rng(5)
POINTS = RNG.uniform(-1, 1, (20, 3)) * [3, 2, 1]
TURN, _ = np.linalg.qr(RNG.standard_normal((3, 3)))
TURN *= np.sign(np.linalg.det(TURN))


def lists(n, *exchanges, wrong=()):
    """n points in a frame of their own, and as they were given: some exchanged, some wrong."""
    target = POINTS[:n].copy()
    for i, j in exchanges:
        target[[i, j]] = target[[j, i]]
    target[list(wrong)] += [0.9, -0.7, 0.4]
    noise = 0.001 * np.random.default_rng(n).standard_normal((n, 3))
    return 0.3 * (POINTS[:n] + noise) @ TURN.T + [5, 6, 7], target


@pytest.mark.parametrize("n", [3, 4, 5, 6, 9, 20])
def test_two_exchanged_points_are_found(n):
    found = contradiction(*lists(n, (0, 2)))
    assert found.exchanges[0] == (0, 2)
    assert found.misfit_after < 0.01 < 0.5 < found.misfit_before
    if n >= 6:  # four or more of the others agree: there is no other explanation
        assert found.all_at_once and found.exchanges == [(0, 2)] and not found.wrong


@pytest.mark.parametrize("n", [2, 3, 5, 20])
def test_points_that_fit_contradict_nothing(n):
    assert contradiction(*lists(n)) is None


def test_two_exchanges_and_a_wrong_point_of_many():
    found = contradiction(*lists(20, (0, 2), (5, 11), wrong=[7]))
    assert found.all_at_once and found.exchanges == [(0, 2), (5, 11)] and found.wrong == [7]


def test_the_corners_of_a_square_have_two_explanations():
    """With A and B exchanged, C and D may be: the square turned over fits as well."""
    square = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], float)
    found = contradiction(square @ TURN.T, square[[1, 0, 2, 3]])
    assert not found.all_at_once and {(0, 1), (2, 3)} <= set(found.exchanges)


def test_five_of_seven_points_agree_in_threes():
    """Two of seven are wrong: of six points at a time one is always wrong."""
    source, target = lists(7, wrong=[2])
    target[5] += [-0.8, 0.3, 0.9]
    found = contradiction(source, target)
    assert found.all_at_once and found.wrong == [2, 5] and not found.exchanges


def test_a_wrong_point_of_four_is_one_explanation():
    """The other three have two conditions left, and fit."""
    found = contradiction(*lists(4, wrong=[3]))
    assert not found.all_at_once and 3 in found.wrong
    # Three always have a similarity that nearly fits two of them: no point of these is left out.
    three = contradiction(*lists(3, wrong=[1]))
    assert three is None or not three.wrong


@pytest.mark.parametrize("off, wrong", [(3.0, []), (7.0, [4])])
def test_four_sigma_of_control_are_chance(off, wrong):
    """One of twenty points is off by so many σ, and by an eighth less after the similarity."""
    sigma, target = 0.5, POINTS.copy()
    target[4, 2] += off * sigma
    found = contradiction(POINTS, target, np.full((20, 3), sigma))
    assert (found.wrong if found else []) == wrong


def test_points_of_another_object_have_no_explanation():
    assert contradiction(POINTS[:8], POINTS[8:16]) is None


def test_the_tolerance_is_that_of_the_sigma_of_control():
    """Handheld control, σ a sixth of its extent, contradicts nothing; exact control would."""
    source, target = lists(9)
    target = target + 0.5 * np.random.default_rng(1).standard_normal(target.shape)
    assert contradiction(source, target, np.full((9, 3), 0.5)) is None
    exact = contradiction(source, target, np.full((9, 3), np.nan))
    assert exact is None or exact.misfit_before > 0.5
    far = target.copy()
    far[[0, 2]] = far[[2, 0]] + [[30, 0, 0], [-30, 0, 0]]
    assert contradiction(source, far, np.full((9, 3), 0.5)) is not None


def test_the_similarity_of_few_points_is_that_of_all():
    """Least squares after Umeyama (1991): of five points none is taken for wrong, since one that is
    draws the seven unknowns so far that it does not show."""
    random = np.random.default_rng(3823)  # one residual is 11 times the median
    source = random.normal(size=(5, 3)) * random.uniform(0.1, 3, (5, 1))
    target = source + 0.01 * random.normal(size=(5, 3))
    target[0] += random.normal(size=3)
    a, b = source - source.mean(0), target - target.mean(0)
    U, S, Vt = np.linalg.svd(b.T @ a)
    sign = np.array([1.0, 1.0, np.linalg.det(U @ Vt)])
    expected = (S @ sign) / (a**2).sum() * (U * sign) @ Vt
    A, t = similarity(source, target)
    np.testing.assert_allclose(A, expected, atol=1e-9)
    np.testing.assert_allclose(A @ source.mean(0) + t, target.mean(0), atol=1e-9)


def test_the_similarity_of_most_points_is_not_spoilt_by_a_third_of_wrong_ones():
    source, target = lists(9, wrong=[1, 4, 8])
    A, t = similarity_of_most(source, target)
    off = np.linalg.norm(source @ A.T + t - target, axis=1)
    assert np.all(np.delete(off, [1, 4, 8]) < 0.01) and np.all(off[[1, 4, 8]] > 0.5)
    # A point off by four robust σ takes no part: chance exceeds 2.5 of one coordinate once in 80.
    noise = 0.001 * np.random.default_rng(2).standard_normal((20, 3))
    noise[9] = [0.004, -0.004, 0.002]
    A, t = similarity_of_most(POINTS, POINTS + noise)
    others = np.arange(20) != 9
    expected = similarity(POINTS[others], (POINTS + noise)[others])
    np.testing.assert_allclose(POINTS @ A.T + t, POINTS @ expected[0].T + expected[1], atol=1e-12)
    on_a_line = np.arange(5.0)[:, None] * [1.0, 2.0, 3.0]
    assert similarity_of_most(on_a_line, on_a_line) is None


def test_of_many_points_some_count():
    """The similarity of three, six or a hundred of 400 points; of two there is none."""
    source = np.random.default_rng(6).normal(size=(400, 3))
    target = 2 * source @ TURN.T + [5, 6, 7]
    for used in (3, 6, 100):
        weights = np.zeros(400)
        weights[-used:] = 1
        A, t = batched.similarity(source, np.where(weights[:, None] > 0, target, 0), weights)
        np.testing.assert_allclose(source @ A.T + t, target, atol=1e-9)
    assert batched.similarity(source, target, np.arange(400) < 2) is None


def test_two_exchanged_points_of_very_many_are_found():
    target = np.random.default_rng(7).uniform(-1, 1, (200, 3))
    source = 0.3 * target @ TURN.T
    target[[20, 71]] = target[[71, 20]]
    assert contradiction(source, target).exchanges == [(20, 71)]


@pytest.mark.parametrize("known, expected", [
    ({"control": 1.0, "rays": 2.0, "points": 3.0}, 1.0), ({"rays": 2.0, "points": 3.0}, 2.0),
    ({"points": 3.0}, 3.0), ({}, None),
])  # fmt: skip
def test_a_model_is_moved_by_the_best_that_is_known_of_its_frame(monkeypatch, known, expected):
    """Control points and stations, else rays to control, else all points but check points."""
    numbers = {4: "control", 5: "points"}  # three control points and a station; three and two ties
    moved = lambda name: (known[name] * np.eye(3), np.zeros(3)) if name in known else None
    by_points = lambda source, target: moved(numbers[len(source)])
    monkeypatch.setattr(alignment, "similarity", by_points)
    monkeypatch.setattr(alignment, "_by_rays", lambda *_: moved("rays"))
    X, roles = POINTS[:6], ("control",) * 3 + ("check",) + ("tie",) * 2
    points = Points(tuple("abcdef"), roles, X, np.full((6, 3), 0.01))
    images = SimpleNamespace(position=np.array([[0.0, 0, 9], [np.nan] * 3]))
    model = SimpleNamespace(
        known=np.ones(6, bool), X=X, X0=np.zeros((2, 3)), placed=np.ones(2, bool),
        transform=lambda A, t: A[0, 0],
    )  # fmt: skip
    network = SimpleNamespace(points=points, images=images)
    assert alignment.move_to_given_frame(network, None, model) == expected


@pytest.mark.parametrize("seed, pair", [(1, (1, 2)), (5, (1, 2)), (2, (1, 3))])
def test_two_exchanged_points_of_five_are_named_whatever_images_they_orient(seed, pair):
    """Images that the wrong points orient fit them in part: the points are judged without them."""
    targets = np.random.default_rng(seed).uniform([-2, -2, -0.6], [2, 2, 0.6], (14, 3))
    camera = Camera("cam", "opencv", {"fx": 3200.0, "fy": 3200.0, "cx": 1999.5, "cy": 1499.5})
    start = dataclasses.replace(camera, parameters=camera.parameters | {"fx": 3150.0, "fy": 3150.0})
    network = jaxbundle.simulate(
        jaxbundle.ring_of_stations(6, 4.0, 6.0, roll_every=2), targets, camera, noise=0.3,
        start=start, control=range(5), control_sigma=0.002, datum="control",
        image_format=(4000, 3000),
    )  # fmt: skip
    images, points = network.images, network.points
    position, order = points.position.copy(), list(range(5))
    i, j = pair
    order[i], order[j] = j, i
    position[:5] = position[order]
    position[5:] = np.nan
    unknown = np.full_like(images.position, np.nan)
    exchanged = network.replace(
        images=dataclasses.replace(images, position=unknown, angles=unknown),
        points=dataclasses.replace(points, position=position),
    )
    try:
        said = jaxbundle.orient(exchanged).finding
    except NotSolvedError as error:
        said = str(error)
    assert f"{points.id[i]!r} and {points.id[j]!r} are exchanged" in said or (
        f"{points.id[j]!r} and {points.id[i]!r} are exchanged" in said
    )
