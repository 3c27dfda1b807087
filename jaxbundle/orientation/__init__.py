"""Orientation without start values: in closed form, refined, and robust.

Pure functions of one image, one pair, one point; batch them with `jax.vmap`. Failures are reported
by a `Status` in the result, not by an exception, so that one bad item does not affect the others.
Image coordinates are ideal ones divided by the principal distance, unless said otherwise.
"""

from jaxbundle.orientation.absolute import AbsoluteOrientation, absolute_orientation
from jaxbundle.orientation.dlt import (
    CameraWithPose,
    RefinedCamera,
    decompose,
    direct_linear_transformation,
    refine_camera,
)
from jaxbundle.orientation.essential import eight_points, five_points, orientations
from jaxbundle.orientation.homography import (
    apply_homography,
    homography,
    interior_from_homographies,
    pose_from_homography,
)
from jaxbundle.orientation.intersection import Intersection, intersection
from jaxbundle.orientation.planar import PlanarOrientations, planar_orientations
from jaxbundle.orientation.pose import CameraPose, image_of, ray_of
from jaxbundle.orientation.relative import RelativeOrientation, relative_orientation
from jaxbundle.orientation.resection import Resection, refine_resection, resection
from jaxbundle.orientation.robust import (
    Consensus,
    consensus,
    robust_absolute_orientation,
    robust_direct_linear_transformation,
    robust_homography,
    robust_intersection,
    robust_relative_orientation,
    robust_resection,
    samples_needed,
)
from jaxbundle.orientation.status import Status
from jaxbundle.orientation.three_points import three_points

__all__ = [
    "AbsoluteOrientation",
    "CameraPose",
    "CameraWithPose",
    "Consensus",
    "Intersection",
    "PlanarOrientations",
    "RefinedCamera",
    "RelativeOrientation",
    "Resection",
    "Status",
    "absolute_orientation",
    "apply_homography",
    "consensus",
    "decompose",
    "direct_linear_transformation",
    "eight_points",
    "five_points",
    "homography",
    "image_of",
    "interior_from_homographies",
    "intersection",
    "orientations",
    "planar_orientations",
    "pose_from_homography",
    "ray_of",
    "refine_camera",
    "refine_resection",
    "relative_orientation",
    "resection",
    "robust_absolute_orientation",
    "robust_direct_linear_transformation",
    "robust_homography",
    "robust_intersection",
    "robust_relative_orientation",
    "robust_resection",
    "samples_needed",
    "three_points",
]
