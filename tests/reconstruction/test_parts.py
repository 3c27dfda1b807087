"""Why a photograph belongs to no part."""

import numpy as np
import pytest

from jaxbundle.reconstruction.parts import why_alone
from jaxbundle.tiepoints.matching import FeatureMatches
from jaxbundle.tiepoints.verification import Pair

NAMES = ["a.jpg", "b.jpg", "c.jpg", "d.jpg"]


def matches(i, j, number):
    rows = np.zeros((number, 2), int)
    return FeatureMatches((i, j), rows, np.zeros(number), np.zeros(number, bool))


PAIR = Pair((0, 3), np.zeros((9, 2), int), np.zeros(9), np.eye(3), np.zeros(3), 0.1, "relative", 9)
MATCHES = [matches(0, 1, 90), matches(1, 2, 7), matches(2, 0, 11)]


@pytest.mark.parametrize("k, found, why", [
    (3, MATCHES, "it overlaps only with a.jpg"),
    (2, MATCHES, "it has too few matches with any other photograph: 11 with a.jpg, but"),
    (1, [MATCHES[1]], "it has too few matches with any other photograph: 7 with c.jpg, but"),
    (2, MATCHES[:1], "it has no matches with any other photograph"),
    (2, [matches(1, 2, 0)], "it has no matches with any other photograph"),
])  # fmt: skip
def test_the_photograph_with_the_most_matches_is_named(k, found, why):
    assert why_alone(k, NAMES, found, [PAIR]).startswith(why)
