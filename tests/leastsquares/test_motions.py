"""The motions that are assumed for a problem whose datum is open."""

import numpy as np
import pytest

from jaxbundle import leastsquares as ls
from jaxbundle.leastsquares.datum.motions import likely_motions

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
