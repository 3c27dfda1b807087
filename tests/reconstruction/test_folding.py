"""Photographs that should show common points and do not."""

from contextlib import nullcontext
from itertools import combinations
from types import SimpleNamespace

import numpy as np
import pytest

from jaxbundle import Camera, adjust, grid_of_targets, simulate
from jaxbundle.errors import NotSolvedError
from jaxbundle.planning.stations import stations_looking_at
from jaxbundle.reconstruction import folding
from jaxbundle.reconstruction.folding import count_shared_points, refuse_superimposed

EACH = 3
"""Photographs of each half."""
ALL = set(combinations(range(2 * EACH), 2))


def adjusted(common):
    """Photographs from nearly one direction; the first three measure one half of the points, the
    others the other half, and all of them the share `common`."""
    rng = np.random.default_rng(1)
    camera = Camera("cam", "brown", {"c": 24.0}, image_size=(3600, 2400), pixel_size=(0.01, 0.01))
    targets = grid_of_targets(16, 12, 0.3, relief=0.4)
    X0 = np.c_[0.5 * np.arange(2 * EACH), rng.normal(size=(2 * EACH)), np.full(2 * EACH, 10.0)]
    at = np.c_[X0[:, :1], np.zeros((2 * EACH, 2))] / 2
    network = simulate(stations_looking_at(X0, at), targets, camera, noise=0.001, seed=3)
    rays = network.observations
    half = rng.integers(0, 2, len(targets))
    both = rng.random(len(targets)) < common
    kept = both[rays.point] | (half[rays.point] == rays.image // EACH)
    return adjust(network.replace(observations=rays.take(kept)))


@pytest.fixture(scope="module")
def whole():
    return adjusted(1.0)


@pytest.fixture(scope="module")
def folded():
    return adjusted(0.03)


def test_photographs_from_one_direction_share_the_points_in_their_fields(whole):
    expected, shared = count_shared_points(whole, whole.network)
    assert (expected == shared).all() and not expected.diagonal().any()
    # their fields contain all points
    assert expected[0, 1] == len(whole.network.points)
    assert refuse_superimposed(whole, whole.network, ALL, whole.network.images.id) == []


def test_superimposed_parts_are_refused(folded):
    names = list(folded.network.images.id)
    with pytest.raises(NotSolvedError, match="too few in 9 of 15 such pairs"):
        refuse_superimposed(folded, folded.network, ALL, names)


def test_a_few_pairs_are_told_and_those_that_were_not_matched_are_no_evidence(folded):
    names = list(folded.network.images.id)
    within = {(i, j) for i, j in ALL if i // EACH == j // EACH}
    assert refuse_superimposed(folded, folded.network, within, names) == []
    (said,) = refuse_superimposed(folded, folded.network, within | {(0, 5)}, names)
    assert f"expected in both {names[0]} and {names[5]}" in said


def test_photographs_from_other_directions_and_distances_are_not_compared(whole):
    angle = np.radians(40.0)
    X0 = np.array(whole.network.images.position)
    X0[0] = [10 * np.sin(angle), 0, 10 * np.cos(angle)]
    X0[1] = [0, 0, 25.0]
    camera = whole.network.cameras[0]
    X = np.asarray(whole.network.points.position)
    stations = stations_looking_at(X0, np.zeros((len(X0), 3)))
    network = simulate(stations, X, camera, noise=0.001, seed=4)
    expected, _ = count_shared_points(adjust(network), network)
    assert not expected[:2].any() and not expected[:, :2].any()
    assert (expected[2:, 2:] > 0).sum() == 12


def test_a_blurred_photograph_with_few_points_is_no_contradiction(whole):
    """Its points are those of its neighbours, but it lacks most of theirs. Of both directions
    together five pairs of 15 have too few, which would refuse the result."""
    rays = whole.network.observations
    kept = (rays.image != 0) | (rays.point % 20 == 0)
    blurred = adjust(whole.network.replace(observations=rays.take(kept)))
    expected, shared = count_shared_points(blurred, blurred.network)
    assert expected[0, 1] == shared[0, 1] == 10
    common, number = (a + a.T for a in (shared, expected))
    assert (common[1:, 0] < 0.1 * number[1:, 0]).all()
    names = blurred.network.images.id
    assert refuse_superimposed(blurred, blurred.network, ALL, names) == []


def test_the_pair_with_most_expected_points_is_named_first(monkeypatch):
    """Of contradictory pairs it is the clearest; those that were not compared say nothing."""
    settings = folding.SuperpositionSettings(max_pairs=9)
    n = 2 * settings.min_points
    expected = np.zeros((4, 4), int)
    for i, j, number in ((0, 1, n), (0, 2, 3 * n), (1, 2, 2 * n), (0, 3, 9 * n)):
        expected[i, j] = expected[j, i] = number
    found = expected, np.zeros((4, 4), int)
    monkeypatch.setattr(folding, "count_shared_points", lambda *_: found)
    names = ["a.jpg", "b.jpg", "c.jpg", "d.jpg"]
    network = SimpleNamespace(images=SimpleNamespace(id=tuple(names)))
    matched = {(0, 1), (0, 2), (1, 2)}
    said = folding.refuse_superimposed(
        SimpleNamespace(network=network), None, matched, names, settings
    )
    pairs = [("a.jpg", "c.jpg"), ("b.jpg", "c.jpg"), ("a.jpg", "b.jpg")]
    assert len(said) == 3
    for words, (one, other), number in zip(said, pairs, (6 * n, 4 * n, 2 * n)):
        assert f"0 of {number} points expected in both {one} and {other} were found" in words


@pytest.mark.parametrize("agreeing, unused, refused", [
    (11, 0, True), (13, 0, False), (11, 3, False),
])  # fmt: skip
def test_a_result_that_most_measurements_contradict_is_refused(agreeing, unused, refused):
    """A third of those of points with two rays in its photographs, 36: another photograph has more,
    and some points are seen once. Positions of features that were left out cannot agree."""
    image = np.repeat([0, 1, 2], [18, 20, 90])
    track = np.concatenate([np.arange(18), np.arange(20), np.arange(90)])
    measured = SimpleNamespace(image=image, track=track)
    network = SimpleNamespace(images=SimpleNamespace(id=("a.jpg", "b.jpg")))
    weighted = SimpleNamespace(
        adjustment=SimpleNamespace(network=network), agreeing_rays=agreeing, unused_features=unused
    )
    names = ["a.jpg", "b.jpg", "c.jpg"]
    error = pytest.raises(NotSolvedError, match="only 11 of 36 measurements in 2 photographs")
    with error if refused else nullcontext():
        folding.refuse_folded(weighted, measured, names)
