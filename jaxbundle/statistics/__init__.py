"""Statistics of an adjustment: cofactors, reliability, blunders, variance components, tests."""

from jaxbundle.statistics.check_points import CheckPoints as CheckPoints
from jaxbundle.statistics.check_points import intersect_check_points as intersect_check_points
from jaxbundle.statistics.cofactors import Cofactors as Cofactors
from jaxbundle.statistics.cofactors import cofactors as cofactors
from jaxbundle.statistics.cofactors import propagate as propagate
from jaxbundle.statistics.cofactors import undamped_factor as undamped_factor
from jaxbundle.statistics.components import Component as Component
from jaxbundle.statistics.components import rescale as rescale
from jaxbundle.statistics.components import variance_components as variance_components
from jaxbundle.statistics.correlation import correlation_matrix as correlation_matrix
from jaxbundle.statistics.correlation import total_correlation as total_correlation
from jaxbundle.statistics.distributions import chi2_quantile as chi2_quantile
from jaxbundle.statistics.distributions import normal_quantile as normal_quantile
from jaxbundle.statistics.distributions import t_quantile as t_quantile
from jaxbundle.statistics.distributions import tau_quantile as tau_quantile
from jaxbundle.statistics.inspection import Inspection as Inspection
from jaxbundle.statistics.reliability import Reliability as Reliability
from jaxbundle.statistics.reliability import external_reliability as external_reliability
from jaxbundle.statistics.reliability import minimal_detectable as minimal_detectable
from jaxbundle.statistics.reliability import reliability as reliability
from jaxbundle.statistics.snooping import Removed as Removed
from jaxbundle.statistics.snooping import snoop as snoop
from jaxbundle.statistics.validity import Reach as Reach
from jaxbundle.statistics.validity import distortion_reach as distortion_reach
from jaxbundle.statistics.validity import farthest_measurements as farthest_measurements
from jaxbundle.statistics.validity import measured_centre as measured_centre
