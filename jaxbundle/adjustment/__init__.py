"""The adjustment: residuals, structured Jacobian, Schur step, solvers, derivatives.

`solve` is the differentiable core (arrays in, arrays out); `jaxbundle.adjust` puts a network in
and statistics around it.
"""

from jaxbundle.adjustment.jacobian import BundleJacobian as BundleJacobian
from jaxbundle.adjustment.jacobian import jacobian as jacobian
from jaxbundle.adjustment.problem import Counts as Counts
from jaxbundle.adjustment.problem import Problem as Problem
from jaxbundle.adjustment.problem import make_problem as make_problem
from jaxbundle.adjustment.problem import require_x64 as require_x64
from jaxbundle.adjustment.residuals import Residuals as Residuals
from jaxbundle.adjustment.residuals import half_square as half_square
from jaxbundle.adjustment.residuals import residuals as residuals
from jaxbundle.adjustment.solve import find_minimum as find_minimum
from jaxbundle.adjustment.solve import make_solver as make_solver
from jaxbundle.adjustment.solve import solve as solve
from jaxbundle.adjustment.solver import TERMINATIONS as TERMINATIONS
from jaxbundle.adjustment.solver import BundleSolver as BundleSolver
from jaxbundle.adjustment.solver import FullStep as FullStep
from jaxbundle.adjustment.solver import SchurDescent as SchurDescent
from jaxbundle.adjustment.solver import TrustRegion as TrustRegion
