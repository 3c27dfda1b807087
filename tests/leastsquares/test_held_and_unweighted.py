"""What is held has no σ, and what has no weight no value: neither is seen in anything else."""

import numpy as np

from jaxbundle import leastsquares as ls
from jaxbundle.leastsquares.indexing.rows import whiten
from jaxbundle.leastsquares.problem import make_problem
from jaxbundle.leastsquares.quality.weakness import find_weak
from jaxbundle.leastsquares.solution import Solution


def test_a_held_direction_of_an_eliminated_row_has_no_sigma():
    """Five points with a held height are as good as the others: none is far."""
    random, points, stations = np.random.default_rng(0), 30, 4
    X, free = random.normal(size=(points, 3)), np.ones((points, 3))
    free[:5, 2] = 0
    seen = ls.Kind("seen", lambda p, t, m: p + t - m, of=("point", "shift"))
    rows = np.repeat(np.arange(points), stations), np.tile(np.arange(stations), points)
    problem = make_problem(
        [ls.Table("point", X, free=free),
         ls.Table("shift", np.zeros((stations, 3)), free=np.arange(stations)[:, None] > [0] * 3)],
        [seen(rows, X[rows[0]] + 1e-4 * random.normal(size=(len(rows[0]), 3)), sigma=1e-4)],
        eliminate="point",
    )  # fmt: skip
    solution = Solution(problem, {table.name: table.value for table in problem.tables})
    weak = find_weak(solution, {"point": np.full(points, 5.0)}, 1.0)
    assert weak.rows == () and weak.judged == points


def test_a_residual_without_weight_does_not_count_whatever_it_is():
    """Also beside correlated ones, whose whitening is a product."""
    found = whiten((1.0, np.nan, 3.0), ((2.0, 0.0, 0.0), (0.0, 0.0, 0.0), (1.0, 0.0, 4.0)))
    np.testing.assert_array_equal(found, [2.0, 0.0, 13.0])
