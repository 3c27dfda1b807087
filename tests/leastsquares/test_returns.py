"""The minimum and the datum in turn: the last minimum counts."""

import dataclasses
from types import SimpleNamespace
from typing import NamedTuple

import numpy as np
import pytest

from jaxbundle.leastsquares import solution
from jaxbundle.leastsquares.iterations.stopping import LIMIT, SETTLED


@dataclasses.dataclass
class Minimum:
    termination: int
    values: float
    steps: int


class History(NamedTuple):
    cost: np.ndarray
    damping: np.ndarray


@pytest.fixture
def fake(monkeypatch):
    """Replaces what `find_minimum` calls."""

    def replace(**changes):
        replacements = {
            "is_large": lambda *_: False,
            "pad_values": lambda problem, values: values,
            "without_filling": lambda problem, values: values,
            "make_solver": lambda problem, **options: None,
            "_worth_sharing": lambda *_: False,
            "with_motions_at": lambda problem, values: SimpleNamespace(),
            "_move_to_datum": lambda problem, values, given: round(values + 0.1, 9),
        } | changes
        for name, function in replacements.items():
            monkeypatch.setattr(solution, name, function)
        return SimpleNamespace(data=SimpleNamespace(start=0.0), observations=(), planning=None)

    return replace


@pytest.mark.parametrize("large", [True, False])
def test_progress_is_told_once(fake, large):
    """During the iterations of a large problem, by its solver; after those of a small one."""
    minimum, told, given = Minimum(SETTLED, 1.0, 2), [], []
    minimum.iterations = 2
    minimum.history = History(np.array([9.0, 3.0, np.nan]), np.ones(3))

    def solver(problem, **options):
        given.append(options)
        return lambda start: minimum

    problem = fake(
        is_large=lambda *_: large, make_solver=solver, with_motions_at=lambda problem, _: problem,
        _on_one_device=lambda problem, solver: solver,
    )  # fmt: skip
    progress = lambda step, cost, damping: told.append((step, cost))
    solution.find_minimum(problem, progress=progress)
    assert given == [{"progress": progress} if large else {}]
    assert told == ([] if large else [(0, 9.0), (1, 3.0)])
    solution.find_minimum(problem)
    assert given[1] == {}


@pytest.mark.parametrize("last", [SETTLED, LIMIT])
def test_the_last_termination_is_that_of_the_result(fake, last):
    """Of a problem whose motion to the datum, a tenth of the way, leaves the minimum at first;
    iterations are those of the first minimum. What has not converged there is not said to have."""
    minima = [Minimum(SETTLED, 1.0, 7), Minimum(last, 1.5, 2)]
    starts, vtpv = [], {1.0: 5.0, 1.1: 6.0, 1.5: 5.0, 1.6: 5.0}

    def minimise(problem, solver):
        return lambda start: starts.append(start) or minima[len(starts) - 1]

    problem = fake(
        _on_one_device=minimise, Solution=lambda problem, values: SimpleNamespace(vtpv=vtpv[values])
    )
    found = solution.find_minimum(problem)
    assert starts == [0.0, 1.1]
    assert (found.termination, found.steps) == (last, 7)
    np.testing.assert_allclose(found.values, 1.6)
