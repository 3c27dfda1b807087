"""The adjustment of networks, cameras and rigs: declarations on the engine.

`solve` is the differentiable core (arrays in, arrays out); `jaxbundle.adjust` puts a network in
and statistics around it.
"""

from jaxbundle.adjustment.equations import design_matrix as design_matrix
from jaxbundle.adjustment.equations import residuals as residuals
from jaxbundle.adjustment.problem import Counts as Counts
from jaxbundle.adjustment.problem import Problem as Problem
from jaxbundle.adjustment.problem import make_problem as make_problem
from jaxbundle.adjustment.solve import solve as solve
