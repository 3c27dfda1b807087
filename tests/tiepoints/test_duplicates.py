"""Photographs that show the same: saved again, reduced, turned, blurred; and what is none."""

import numpy as np
import pytest

from jaxbundle.tiepoints.duplicates import find_duplicates
from jaxbundle.tiepoints.features import Features
from jaxbundle.tiepoints.matching import FeatureMatches

SIZE = (3000, 2000)
NUMBER = 400


def features(xy, size=12.0):
    n = len(xy)
    return Features(np.asarray(xy, float), np.full(n, size), np.zeros(n),
                    np.zeros((n, 128), np.uint8))  # fmt: skip


def every_match(i, j, number):
    rows = np.stack([np.arange(number)] * 2, 1)
    return FeatureMatches((i, j), rows, np.full(number, 0.5), np.ones(number, bool))


@pytest.fixture
def original():
    return np.random.default_rng(3).uniform(0, 1, (NUMBER, 2)) * SIZE


def look(xy, other, other_size=SIZE, size=12.0, number=None):
    found = [features(xy), features(other, size)]
    return find_duplicates([every_match(0, 1, number or len(other))], found, [SIZE, other_size])


@pytest.mark.parametrize("how", ["saved again", "halved", "upright", "blurred", "wrong matches"])
def test_the_same_photograph_is_found(original, how):
    rng = np.random.default_rng(1)
    other, size, width = original + rng.normal(scale=0.5, size=original.shape), SIZE, 12.0
    if how == "halved":
        other, size = (other + 0.5) / 2 - 0.5, (1500, 1000)
    elif how == "upright":  # turned by 90 degrees: v of the sensor is counted from the right
        other, size = np.stack([SIZE[1] - 1 - other[:, 1], other[:, 0]], 1), SIZE[::-1]
    elif how == "blurred":
        other, width = (other + rng.normal(scale=4, size=other.shape))[: NUMBER // 3], 50.0
    elif how == "wrong matches":
        other[: NUMBER // 20] = other[: NUMBER // 20][::-1]
    found = look(original, other, size, width)
    # the one with fewer features is left out, of equal ones the second
    assert found.keys() == {1} and found[1][0] == 0 and found[1][1] >= 0.9 * found[1][2]


@pytest.mark.parametrize("how", ["moved", "turntable", "date", "corner", "cropped"])
def test_others_are_not(original, how):
    other, size, number = original.copy(), SIZE, NUMBER
    if how == "moved":  # by a fifth of a degree
        other[:, 0] += 12.0
    elif how == "turntable":  # of a fixed camera: a fifth of the matches moves
        other[: NUMBER // 5] += 60.0
    elif how == "date":
        number = 40
    elif how == "corner":
        number = 200
        original = np.concatenate([0.2 * original[:number], original[number:]])
        other = original.copy()
    elif how == "cropped":
        other, size = original * 0.8, (3000, 1800)
    assert look(original, other, size, number=number) == {}


def test_a_chain_of_nearly_equal_photographs_keeps_every_second_one(original):
    """Each is 0.15 % of the side from the next: frames of a slow video."""
    moved = [features(original + [4.5 * k, 0]) for k in range(4)]
    pairs = [every_match(i, j, NUMBER) for i in range(4) for j in range(i + 1, 4)]
    found = find_duplicates(pairs, moved, [SIZE] * 4)
    assert {k: v[0] for k, v in found.items()} == {1: 0, 3: 2}


@pytest.mark.parametrize("rows, found", [(2000, True), (1990, True), (1900, False)])
def test_photographs_of_another_shape_do_not_show_the_same(original, rows, found):
    """Stretched to the same frame their features would; whole pixels of a reduced one are no other
    shape."""
    stretched = (original + 0.5) * [1, rows / 2000] - 0.5
    assert bool(look(original, stretched, (3000, rows))) == found
