"""The solution of a network that was changed a little: less weight here, none there.

A large one takes a single Gauss–Newton step from the solution before, which lands within the square
of the change: near enough to see what to change next. A small one would wait longer for the
compilation of the step than for its solutions.
"""

from collections.abc import Callable

from jaxbundle.adjustment.problem import Problem
from jaxbundle.adjustment.solve import take_step
from jaxbundle.network.arrays import Values
from jaxbundle.network.padding import without_filling
from jaxbundle.statistics.inspection import Inspection

Adjust = Callable[[Problem, Values], Inspection]
"""The solution of a problem, from start values; refuses what is not solved."""

STEPPING = 20_000
"""Networks of so many rays take single steps."""


def readjust(problem: Problem, values: Values, adjust_from: Adjust) -> Inspection:
    """The solution by one step from `values` if the network is large and the step decreases vᵀPv,
    else by `adjust_from`. What is final is to be adjusted once more."""
    if problem.structure.rays >= STEPPING:
        before = Inspection(problem, values)
        stepped = take_step(before.structure, before.values, before.data)
        after = Inspection(problem, without_filling(stepped, problem.data.start))
        if after.vtpv <= before.vtpv:
            return after
    return adjust_from(problem, values)
