"""A least-squares engine on tables of unknowns and kinds of observations, independent of
photographs.

    from jaxbundle import leastsquares as ls
"""

from jaxbundle.leastsquares.adjust import Result as Result
from jaxbundle.leastsquares.adjust import adjust as adjust
from jaxbundle.leastsquares.datum.motions import shift as shift
from jaxbundle.leastsquares.datum.motions import similarity as similarity
from jaxbundle.leastsquares.datum.motions import similarity_of_plane as similarity_of_plane
from jaxbundle.leastsquares.declarations import Kind as Kind
from jaxbundle.leastsquares.declarations import Motions as Motions
from jaxbundle.leastsquares.declarations import ObservationSet as ObservationSet
from jaxbundle.leastsquares.declarations import Table as Table
from jaxbundle.leastsquares.indexing.rows import Data as Data
from jaxbundle.leastsquares.indexing.rows import Values as Values
from jaxbundle.leastsquares.indexing.settings import PlanningSettings as PlanningSettings
from jaxbundle.leastsquares.iterations.search import MarquardtDescent as MarquardtDescent
from jaxbundle.leastsquares.iterations.search import NielsenTrustRegion as NielsenTrustRegion
from jaxbundle.leastsquares.iterations.search import RegionSettings as RegionSettings
from jaxbundle.leastsquares.iterations.stopping import StoppingSettings as StoppingSettings
from jaxbundle.leastsquares.problem import Problem as Problem
from jaxbundle.leastsquares.problem import make_problem as make_problem
from jaxbundle.leastsquares.quality.derivatives import solve as solve
from jaxbundle.leastsquares.quality.precision import precision as precision
from jaxbundle.leastsquares.spaces import Direction as Direction
from jaxbundle.leastsquares.spaces import Pose as Pose
from jaxbundle.leastsquares.spaces import PoseValue as PoseValue
from jaxbundle.leastsquares.spaces import Rotation as Rotation
from jaxbundle.leastsquares.spaces import Vector as Vector
