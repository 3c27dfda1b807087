"""Orientation without start values: in closed form, refined, and robust.

Pure functions of one image, one pair, one point; batch them with `jax.vmap`. Failures are reported
by a `Status` in the result, not by an exception, so that one bad item does not affect the others.
Image coordinates are ideal ones divided by the principal distance, unless said otherwise.
"""

from jaxbundle.orientation.absolute import AbsoluteOrientation as AbsoluteOrientation
from jaxbundle.orientation.absolute import absolute_orientation as absolute_orientation
from jaxbundle.orientation.dlt import CameraWithPose as CameraWithPose
from jaxbundle.orientation.dlt import RefinedCamera as RefinedCamera
from jaxbundle.orientation.dlt import decompose as decompose
from jaxbundle.orientation.dlt import direct_linear_transformation as direct_linear_transformation
from jaxbundle.orientation.dlt import refine_camera as refine_camera
from jaxbundle.orientation.essential import eight_points as eight_points
from jaxbundle.orientation.essential import five_points as five_points
from jaxbundle.orientation.essential import orientations as orientations
from jaxbundle.orientation.homography import apply_homography as apply_homography
from jaxbundle.orientation.homography import homography as homography
from jaxbundle.orientation.homography import (
    interior_from_homographies as interior_from_homographies,
)
from jaxbundle.orientation.homography import pose_from_homography as pose_from_homography
from jaxbundle.orientation.intersection import Intersection as Intersection
from jaxbundle.orientation.intersection import intersection as intersection
from jaxbundle.orientation.planar import PlanarOrientations as PlanarOrientations
from jaxbundle.orientation.planar import planar_orientations as planar_orientations
from jaxbundle.orientation.pose import CameraPose as CameraPose
from jaxbundle.orientation.pose import image_of as image_of
from jaxbundle.orientation.pose import ray_of as ray_of
from jaxbundle.orientation.relative import RelativeOrientation as RelativeOrientation
from jaxbundle.orientation.relative import relative_orientation as relative_orientation
from jaxbundle.orientation.resection import Resection as Resection
from jaxbundle.orientation.resection import refine_resection as refine_resection
from jaxbundle.orientation.resection import resection as resection
from jaxbundle.orientation.robust import Consensus as Consensus
from jaxbundle.orientation.robust import consensus as consensus
from jaxbundle.orientation.robust import robust_absolute_orientation as robust_absolute_orientation
from jaxbundle.orientation.robust import (
    robust_direct_linear_transformation as robust_direct_linear_transformation,
)
from jaxbundle.orientation.robust import robust_homography as robust_homography
from jaxbundle.orientation.robust import robust_intersection as robust_intersection
from jaxbundle.orientation.robust import robust_relative_orientation as robust_relative_orientation
from jaxbundle.orientation.robust import robust_resection as robust_resection
from jaxbundle.orientation.robust import samples_needed as samples_needed
from jaxbundle.orientation.status import Status as Status
from jaxbundle.orientation.three_points import three_points as three_points
