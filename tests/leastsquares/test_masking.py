"""Which observations of a problem can mask each other's blunders: those of one eliminated row, and
those of one kept row."""

import jax.numpy as jnp
import numpy as np

from jaxbundle import leastsquares as ls
from jaxbundle.leastsquares.problem import make_problem
from jaxbundle.leastsquares.quality.names import eliminated_rows
from jaxbundle.leastsquares.quality.snooping import _TouchedRows

VIEW = ls.Kind("view", lambda p, s, t, y: p + s + t - y, of=("point", "shift", "tilt"))
RANGE = ls.Kind("range", lambda a, b, d: jnp.sum((a - b) ** 2) - d, of=("point", "point"))


def test_observations_are_grouped_by_eliminated_row_and_first_kept_row():
    """Points 1 and 3 are coupled by a range, and kept; point 4 and shift 0 are held."""
    n, shifts = 5, 3
    point, shift = (x.ravel() for x in np.meshgrid(np.arange(n), np.arange(shifts), indexing="ij"))
    tilt = np.arange(len(point)) % 2
    problem = make_problem(
        [ls.Table("point", np.arange(2.0 * n).reshape(n, 2), free=np.arange(n)[:, None] != [4, 4]),
         ls.Table("shift", np.zeros((shifts, 2)), free=np.arange(shifts)[:, None] > [0, 0]),
         ls.Table("tilt", np.zeros((2, 2)))],
        [VIEW((point, shift, tilt), np.zeros((len(point), 2))), RANGE(([1], [3]), [32.0])],
        eliminate="point",
    )  # fmt: skip
    assert problem.plan.eliminated == "point"
    touched = _TouchedRows(problem)
    alone = np.isin(point, [0, 2])
    np.testing.assert_array_equal(touched.eliminated_row["view"], np.where(alone, point, -1))
    np.testing.assert_array_equal(touched.first_kept_row["view"], n + shift)
    assert touched.eliminated_row["range"] == [-1]
    # Unknowns that nothing determines belong to their eliminated row; others to none.
    names = ["1 of point 3", "2 of point 3", "1 of point 2", "1 of shift 3", "1 of point"]
    assert eliminated_rows(problem, names) == [2]
