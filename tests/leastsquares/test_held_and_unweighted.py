"""What is held has no σ, and what has no weight no value: neither is seen in anything else."""

import numpy as np
import pytest

from jaxbundle import leastsquares as ls
from jaxbundle.leastsquares.indexing.layout import chunk_length
from jaxbundle.leastsquares.indexing.rows import whiten
from jaxbundle.leastsquares.indexing.settings import PLANNING, PlanningSettings
from jaxbundle.leastsquares.problem import make_problem
from jaxbundle.leastsquares.quality import weakness
from jaxbundle.leastsquares.quality.weakness import find_weak
from jaxbundle.leastsquares.solution import Solution, find_minimum


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


def test_the_weakest_unknown_of_a_large_system_is_found_without_its_cofactors(monkeypatch):
    """By subspace iteration; it is connected with no other unknown, and beyond the directions that
    it follows at a time. Held unknowns have no σ."""
    of, sigma = np.arange(12), np.full((12, 1), 1e-3)
    free = of[:, None] % 4 != 1
    sigma[[1, 10]] = 10.0
    level = ls.Kind("level", lambda x, m: x - m, of=("height",))
    heights = ls.Table("height", np.zeros((12, 1)), free=free, labels=list("abcdefghijkl"))
    problem = make_problem([heights], [level((of,), np.zeros((12, 1)), sigma=sigma)])
    monkeypatch.setattr(weakness, "SMALL_SYSTEM", 0)
    found = Solution(problem, {"height": heights.value})
    weak = find_weak(found, {"height": np.full((12, 1), 1.0)}, 1.0)
    assert weak.names == ("1 of height k",) and weak.worst == pytest.approx(10.0, rel=1e-6)


def test_rows_of_a_held_table_vary_within_a_chunk():
    """A chunk has observations of the same estimated rows; those of a held table, which form no
    equations, are others for each observation: the offset of three stations is the mean of what
    they read less the known heights."""
    random, stations, known = np.random.default_rng(1), 3, 200
    height = random.uniform(0, 50, known)
    row, of = (x.ravel() for x in np.meshgrid(np.arange(stations), np.arange(known)))
    read = height[of] + np.array([1.0, 2.0, 3.0])[row] + 0.1 * random.normal(size=len(row))
    reading = ls.Kind("reading", lambda o, h, m: o + h - m, of=("offset", "height"))
    problem = make_problem(
        [ls.Table("offset", np.zeros(stations)), ls.Table("height", height, free=False)],
        [reading((row, of), read)], planning=PlanningSettings(small_part=100),
    )  # fmt: skip
    assert problem.plan.parts[0].source.shape[1] > 1
    found = find_minimum(problem).values["offset"]
    expected = [(read - height[of])[row == k].mean() for k in range(stations)]
    np.testing.assert_allclose(found, expected, rtol=1e-9)


def test_only_large_parts_are_computed_in_long_chunks():
    """The program of a small part without chunks compiles in a tenth of the time; one of a large
    part needs chunks to run at speed."""
    few, many = PLANNING.small_part - 1, PLANNING.small_part
    assert chunk_length(np.zeros(few, int), PLANNING) == 1
    assert chunk_length(np.zeros(many, int), PLANNING) == max(PLANNING.chunk_lengths)
    assert chunk_length(np.arange(many), PLANNING) == 1  # would be padding for the most part


def test_a_residual_without_weight_does_not_count_whatever_it_is():
    """Also beside correlated ones, whose whitening is a product."""
    found = whiten((1.0, np.nan, 3.0), ((2.0, 0.0, 0.0), (0.0, 0.0, 0.0), (1.0, 0.0, 4.0)))
    np.testing.assert_array_equal(found, [2.0, 0.0, 13.0])


def test_without_redundancy_weakness_is_judged_by_the_given_sigma():
    """There is no σ0 of residuals."""
    level = ls.Kind("level", lambda x, m: x - m, of=("height",))
    # a fiftieth of the extent is the limit
    sigma = np.array([[1e-3], [0.015], [0.03]])
    heights = ls.Table("height", np.zeros((3, 1)), labels=list("abc"))
    problem = make_problem([heights], [level((np.arange(3),), np.zeros((3, 1)), sigma=sigma)])
    found = Solution(problem, {"height": heights.value})
    weak = find_weak(found, {"height": np.ones((3, 1))}, np.nan)
    assert weak.names == ("1 of height c",) and weak.worst == pytest.approx(0.03)
