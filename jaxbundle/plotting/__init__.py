"""Figures of an adjustment (extra `plots`: matplotlib).

Every function draws on the axes given as `ax`, or on those of a new pyplot figure, and returns
them. `save_figures` writes all of them as PNG files without touching pyplot.
"""

from jaxbundle.plotting.calibrations import difference_map as difference_map
from jaxbundle.plotting.calibrations import radial_curves as radial_curves
from jaxbundle.plotting.cameras import correlation_matrix as correlation_matrix
from jaxbundle.plotting.cameras import distortion_curve as distortion_curve
from jaxbundle.plotting.distortion import DistortionProfile as DistortionProfile
from jaxbundle.plotting.distortion import distortion_profile as distortion_profile
from jaxbundle.plotting.files import save_figures as save_figures
from jaxbundle.plotting.files import write_figures as write_figures
from jaxbundle.plotting.image_map import image_map as image_map
from jaxbundle.plotting.images import residual_histogram as residual_histogram
from jaxbundle.plotting.images import residual_vectors as residual_vectors
from jaxbundle.plotting.quality import coverage_map as coverage_map
from jaxbundle.plotting.quality import uncertainty_curve as uncertainty_curve
from jaxbundle.plotting.quality import uncertainty_image as uncertainty_image
from jaxbundle.plotting.surfaces import cloud_perspective as cloud_perspective
from jaxbundle.plotting.surfaces import dsm_relief as dsm_relief
from jaxbundle.plotting.views import network_perspective as network_perspective
from jaxbundle.plotting.views import network_plan as network_plan
