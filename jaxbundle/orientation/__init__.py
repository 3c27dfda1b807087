"""Start values without start values: orientation in closed form, refined, and robust.

Pure functions of one image, one pair, one point; batch them with `jax.vmap`. What fails is named
by a `Status` in the result, never by an exception, so that one bad item does not spoil the others.
Image coordinates are ideal ones divided by the principal distance, unless said otherwise.
"""

from .absolute import AbsoluteOrientation as AbsoluteOrientation
from .absolute import absolute_orientation as absolute_orientation
from .dlt import Camera as Camera
from .dlt import RefinedCamera as RefinedCamera
from .dlt import decompose as decompose
from .dlt import direct_linear_transformation as direct_linear_transformation
from .dlt import refine_camera as refine_camera
from .essential import eight_points as eight_points
from .essential import five_points as five_points
from .essential import orientations as orientations
from .homography import apply_homography as apply_homography
from .homography import homography as homography
from .homography import interior_from_homographies as interior_from_homographies
from .homography import pose_from_homography as pose_from_homography
from .intersection import Intersection as Intersection
from .intersection import intersection as intersection
from .planar import PlanarOrientations as PlanarOrientations
from .planar import planar_orientations as planar_orientations
from .pose import Pose as Pose
from .pose import image_of as image_of
from .pose import ray_of as ray_of
from .relative import RelativeOrientation as RelativeOrientation
from .relative import relative_orientation as relative_orientation
from .resection import Resection as Resection
from .resection import refine_resection as refine_resection
from .resection import resection as resection
from .robust import Consensus as Consensus
from .robust import consensus as consensus
from .robust import robust_absolute_orientation as robust_absolute_orientation
from .robust import (
    robust_direct_linear_transformation as robust_direct_linear_transformation,
)
from .robust import robust_homography as robust_homography
from .robust import robust_intersection as robust_intersection
from .robust import robust_relative_orientation as robust_relative_orientation
from .robust import robust_resection as robust_resection
from .robust import samples_needed as samples_needed
from .status import Status as Status
from .three_points import three_points as three_points
