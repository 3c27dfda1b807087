"""Which table is eliminated."""

import numpy as np
import pytest

from jaxbundle import leastsquares as ls
from jaxbundle.leastsquares.adjust import choose_eliminated

VIEW = ls.Kind("view", lambda p, s, y: p - y, of=("point", "pose"))
RANGE = ls.Kind("range", lambda a, b, d: a - b - d, of=("pose", "pose"))


@pytest.mark.parametrize("points, poses, chosen", [
    (26, 74, "point"),  # the poses are coupled among themselves
    (25, 75, None),  # a quarter leaves (3/4)³ of the operations
    (40, 19, None),  # few unknowns
    (40, 20, "point"),
])  # fmt: skip
def test_the_largest_table_whose_rows_are_not_coupled(points, poses, chosen):
    tables = [ls.Table("point", np.zeros(points)), ls.Table("pose", np.zeros(poses))]
    seen = VIEW((np.zeros(3, int), np.arange(3)), np.zeros(3))
    assert choose_eliminated(tables, [seen, RANGE(([0], [1]), [0.0])]) == chosen
