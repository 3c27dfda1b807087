"""The minimum and the datum in turn: the last minimum counts."""

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest

from jaxbundle.leastsquares import solution
from jaxbundle.leastsquares.iterations.stopping import LIMIT, SETTLED


@dataclasses.dataclass
class Minimum:
    termination: int
    values: float
    steps: int


@pytest.mark.parametrize("last", [SETTLED, LIMIT])
def test_the_last_termination_is_that_of_the_result(monkeypatch, last):
    """Of a problem whose motion to the datum, a tenth of the way, leaves the minimum at first;
    iterations are those of the first minimum. What has not converged there is not said to have."""
    minima = [Minimum(SETTLED, 1.0, 7), Minimum(last, 1.5, 2)]
    starts, vtpv = [], {1.0: 5.0, 1.1: 6.0, 1.5: 5.0, 1.6: 5.0}

    def minimise(problem, solver):
        return lambda start: starts.append(start) or minima[len(starts) - 1]

    problem = SimpleNamespace(data=SimpleNamespace(start=0.0), observations=(), planning=None)
    replacements = {
        "is_large": lambda *_: False,
        "pad_values": lambda problem, values: values,
        "without_filling": lambda problem, values: values,
        "make_solver": lambda problem, **options: None,
        "_worth_sharing": lambda *_: False,
        "_on_one_device": minimise,
        "with_motions_at": lambda problem, values: SimpleNamespace(),
        "_move_to_datum": lambda problem, values, given: round(values + 0.1, 9),
        "Solution": lambda problem, values: SimpleNamespace(vtpv=vtpv[values]),
    }
    for name, function in replacements.items():
        monkeypatch.setattr(solution, name, function)
    found = solution.find_minimum(problem)
    assert starts == [0.0, 1.1]
    assert (found.termination, found.steps) == (last, 7)
    np.testing.assert_allclose(found.values, 1.6)
