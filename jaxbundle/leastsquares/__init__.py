"""A least-squares engine on tables of unknowns and kinds of observations, independent of
photographs.

    from jaxbundle import leastsquares as ls
"""

from jaxbundle.leastsquares.adjust import Result, adjust
from jaxbundle.leastsquares.bridge import stock_problem, values_of
from jaxbundle.leastsquares.datum.motions import shift, similarity, similarity_of_plane
from jaxbundle.leastsquares.declarations import Kind, Motions, ObservationSet, Table
from jaxbundle.leastsquares.indexing.rows import Data, Values
from jaxbundle.leastsquares.indexing.settings import PlanningSettings
from jaxbundle.leastsquares.iterations.search import (
    MarquardtDescent,
    NielsenTrustRegion,
    RegionSettings,
)
from jaxbundle.leastsquares.iterations.stopping import StoppingSettings
from jaxbundle.leastsquares.problem import Problem, make_problem
from jaxbundle.leastsquares.quality.derivatives import solve
from jaxbundle.leastsquares.quality.distributions import critical_w, tau_quantile
from jaxbundle.leastsquares.quality.precision import precision
from jaxbundle.leastsquares.quality.reliability import external_reliability, minimal_detectable
from jaxbundle.leastsquares.solution import Solution, find_minimum
from jaxbundle.leastsquares.spaces import Direction, Pose, PoseValue, Rotation, Vector

__all__ = [
    "Data",
    "Direction",
    "Kind",
    "MarquardtDescent",
    "Motions",
    "NielsenTrustRegion",
    "ObservationSet",
    "PlanningSettings",
    "Pose",
    "PoseValue",
    "Problem",
    "RegionSettings",
    "Result",
    "Rotation",
    "Solution",
    "StoppingSettings",
    "Table",
    "Values",
    "Vector",
    "adjust",
    "critical_w",
    "external_reliability",
    "find_minimum",
    "make_problem",
    "minimal_detectable",
    "precision",
    "shift",
    "similarity",
    "similarity_of_plane",
    "solve",
    "stock_problem",
    "tau_quantile",
    "values_of",
]
