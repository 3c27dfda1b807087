"""Figures of an adjustment (extra `plots`: matplotlib).

Every function draws on the axes given as `ax`, or on those of a new pyplot figure, and returns
them. `save_figures` writes all of them as PNG files without touching pyplot.
"""

from jaxbundle.plotting.calibrations import difference_map, radial_curves
from jaxbundle.plotting.cameras import correlation_matrix, distortion_curve
from jaxbundle.plotting.designs import network_view, places_tried
from jaxbundle.plotting.distortion import DistortionProfile, distortion_profile
from jaxbundle.plotting.files import save_figures, write_figures
from jaxbundle.plotting.image_map import image_map
from jaxbundle.plotting.images import residual_histogram, residual_vectors
from jaxbundle.plotting.quality import coverage_map, uncertainty_curve, uncertainty_image
from jaxbundle.plotting.surfaces import cloud_perspective, dsm_relief
from jaxbundle.plotting.views import network_perspective, network_plan

__all__ = [
    "DistortionProfile",
    "cloud_perspective",
    "correlation_matrix",
    "coverage_map",
    "difference_map",
    "distortion_curve",
    "distortion_profile",
    "dsm_relief",
    "image_map",
    "network_perspective",
    "network_plan",
    "network_view",
    "places_tried",
    "radial_curves",
    "residual_histogram",
    "residual_vectors",
    "save_figures",
    "uncertainty_curve",
    "uncertainty_image",
    "write_figures",
]
