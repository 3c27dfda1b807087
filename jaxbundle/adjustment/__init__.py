"""The adjustment of networks: from a network to its result.

`make_problem` declares a network to the engine, `solve` is the differentiable core (arrays in,
arrays out); `jaxbundle.adjust` (`adjust.py`) adds start values, the rounds of a whole adjustment
and the `Adjustment` (`result.py`), whose statistics are in `quality`.
"""

from jaxbundle.adjustment.equations import design_matrix as design_matrix
from jaxbundle.adjustment.equations import residuals as residuals
from jaxbundle.adjustment.problem import Counts as Counts
from jaxbundle.adjustment.problem import NetworkProblem as NetworkProblem
from jaxbundle.adjustment.problem import make_problem as make_problem
from jaxbundle.adjustment.solve import solve as solve
