"""Data snooping: which of the removed observations stay removed."""

import pytest

from jaxbundle.leastsquares.quality.snooping import Removed, _without_passing


@pytest.mark.parametrize("passing, rows", [
    ((), (3, 4, 5)), ((3,), (4, 5)), ((4,), (3, 5)), ((3, 4, 5), (3, 4, 5)),
])  # fmt: skip
def test_of_inseparable_observations_those_that_pass_come_back(passing, rows):
    """If each passes without the others, they contradict each other: which one is wrong remains
    unknown, and all stay removed. A single one that passes comes back."""
    together, single = Removed("ray", 3, None, 9.0, (4, 5)), Removed("height", 3, None, 5.0)
    passed = {("ray", row, None) for row in passing}
    (left, other) = _without_passing([together, single], passed)
    assert left.rows == rows and other == single
    assert list(_without_passing([single], {("height", 3, None)})) == []
