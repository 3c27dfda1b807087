"""The adjustment of networks, cameras and rigs, declared on the engine.

`solve` is the differentiable core (arrays in, arrays out); `jaxbundle.adjust` adds networks and
statistics.
"""

from jaxbundle.adjustment.equations import design_matrix as design_matrix
from jaxbundle.adjustment.equations import residuals as residuals
from jaxbundle.adjustment.problem import Counts as Counts
from jaxbundle.adjustment.problem import NetworkProblem as NetworkProblem
from jaxbundle.adjustment.problem import make_problem as make_problem
from jaxbundle.adjustment.solve import solve as solve
