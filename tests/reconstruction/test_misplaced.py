"""Photographs that contradict their pairs are found, and only they."""

import dataclasses

import numpy as np
import pytest

import jaxbundle
from jaxbundle.network.subsets import keep_images
from jaxbundle.orientation import batched
from jaxbundle.reconstruction.misplaced import find_misplaced
from jaxbundle.tiepoints.verification import Pair


@pytest.fixture(scope="module")
def network():
    camera = jaxbundle.Camera("c", "brown", {"c": 100.0})
    return jaxbundle.simulate(
        jaxbundle.ring_of_stations(6, 6.0, 5.0), jaxbundle.grid_of_targets(4, 4, 0.6), camera,
        noise=0.001,
    )


@pytest.fixture(scope="module")
def pairs(network):
    X0, M = network.images.position, np.asarray(batched.matrices(network.images.angles))
    none = np.zeros((9, 2), int)

    def pair(i, j):
        b = M[i] @ (X0[j] - X0[i])
        return Pair((i, j), none, np.zeros(9), M[j] @ M[i].T, b / np.linalg.norm(b), 0.2,
                    "relative", 9)  # fmt: skip

    id = network.images.id
    return {(id[i], id[j]): pair(i, j) for i in range(6) for j in range(i + 1, 6)}


def moved(network, k, position=(0, 0, 0), angles=(0, 0, 0)):
    images = network.images
    X0, turned = images.position.copy(), images.angles.copy()
    X0[k] += position
    turned[k] += angles
    return network.replace(images=dataclasses.replace(images, position=X0, angles=turned))


def test_coarse_start_values_contradict_nothing(network, pairs):
    assert find_misplaced(network, pairs) == {}
    assert find_misplaced(moved(network, 2, (0.2, -0.2, 0.1), (0.05, 0.05, -0.05)), pairs) == {}


@pytest.mark.parametrize("error", [{"position": (9.0, 0, 0)}, {"angles": (0, 0, np.pi)}])
def test_one_elsewhere_is_found_and_not_its_partners(network, pairs, error):
    found = find_misplaced(moved(network, 3, **error), pairs)
    assert list(found) == [network.images.id[3]]
    assert "contradicts" in found[network.images.id[3]] and "of its 5 pairs" in str(found)


def test_single_wrong_pairs_contradict_no_photograph(network, pairs):
    first, *_ = pairs
    turned = dataclasses.replace(pairs[first], M=-pairs[first].M)
    assert find_misplaced(network, {**pairs, first: turned}) == {}
    few = dict(list(pairs.items())[:2])  # two pairs of one image
    assert find_misplaced(moved(network, 0, (9.0, 0, 0)), few) == {}


def test_a_partner_with_one_pair_does_not_hide_the_misplaced_one(network, pairs):
    elsewhere, id = moved(network, 3, (9.0, 0, 0)), network.images.id
    first = (id[0], id[3])
    fewer = {first: pairs[first]} | {p: one for p, one in pairs.items() if id[0] not in p}
    assert list(find_misplaced(elsewhere, fewer)) == [id[3]]


def test_if_most_contradict_their_pairs_none_is_chosen(network, pairs):
    about = np.array([[np.cos(0.4), -np.sin(0.4), 0], [np.sin(0.4), np.cos(0.4), 0], [0, 0, 1]])
    turned = {ids: dataclasses.replace(p, M=about @ p.M) for ids, p in pairs.items()}
    assert find_misplaced(network, turned) == {}


def test_no_images_contradict_nothing(network, pairs):
    assert find_misplaced(keep_images(network, np.zeros(6, bool)), pairs) == {}


def test_the_base_of_a_narrow_pair_or_of_a_rotation_says_nothing(network, pairs):
    narrow = {ids: dataclasses.replace(p, angle=0.01) for ids, p in pairs.items()}
    turned = {ids: dataclasses.replace(p, kind="rotation") for ids, p in pairs.items()}
    for given in (narrow, turned):
        assert find_misplaced(moved(network, 3, (9.0, 0, 0)), given) == {}
        assert find_misplaced(moved(network, 3, angles=(0, 0, np.pi)), given) != {}
