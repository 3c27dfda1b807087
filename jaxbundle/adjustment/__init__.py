"""The adjustment of networks: from a network to its result.

`make_problem` declares a network to the engine, `solve` is the differentiable core (arrays in,
arrays out); `jaxbundle.adjust` (`adjust.py`) adds start values, the rounds of a whole adjustment
and the `Adjustment` (`result.py`), whose statistics are in `quality`.
"""

from jaxbundle.adjustment.observation_equations import design_matrix, residuals
from jaxbundle.adjustment.problem import Counts, NetworkProblem, make_problem
from jaxbundle.adjustment.solve import solve

__all__ = [
    "Counts",
    "NetworkProblem",
    "design_matrix",
    "make_problem",
    "residuals",
    "solve",
]
