"""Image measurement: targets, boards, fiducial marks, correlation; from pixels to points.

Pixel (0, 0) is the centre of the upper-left pixel, u to the right, v down; a photograph is an array
[rows, columns] of grey values.
"""

from jaxbundle.measure.board_points import BoardPoints
from jaxbundle.measure.boards import Board, BoardSet
from jaxbundle.measure.coded_targets import NamedPoints, find_coded_targets
from jaxbundle.measure.corners import find_board, find_board_points
from jaxbundle.measure.cube_filter import filter_cloud
from jaxbundle.measure.ellipses import Ellipse, circle_centre_shift, fit_ellipse, rim_centre_shift
from jaxbundle.measure.fiducials import Transformation, fit_fiducials
from jaxbundle.measure.least_squares_matching import (
    LeastSquaresMatch,
    MatchingStatus,
    grey_value,
    match_least_squares,
)
from jaxbundle.measure.matching import Match, correlation, find_match
from jaxbundle.measure.moving_blobs import BlobSettings
from jaxbundle.measure.ring_targets import RingSettings, ring_codes
from jaxbundle.measure.targets import Target, centre_by_ellipse, centre_by_grey_values
from jaxbundle.measure.transfer import (
    View,
    ground_point,
    image_point,
    image_to_image,
    line_of_sight,
)
from jaxbundle.measure.views import BoardViews, measure_boards
from jaxbundle.network.units import image_from_pixel, pixel_from_image
from jaxbundle.photographs import read_photograph

__all__ = [
    "BlobSettings",
    "Board",
    "BoardPoints",
    "BoardSet",
    "BoardViews",
    "Ellipse",
    "LeastSquaresMatch",
    "Match",
    "MatchingStatus",
    "NamedPoints",
    "RingSettings",
    "Target",
    "Transformation",
    "View",
    "centre_by_ellipse",
    "centre_by_grey_values",
    "circle_centre_shift",
    "correlation",
    "filter_cloud",
    "find_board",
    "find_board_points",
    "find_coded_targets",
    "find_match",
    "fit_ellipse",
    "fit_fiducials",
    "grey_value",
    "ground_point",
    "image_from_pixel",
    "image_point",
    "image_to_image",
    "line_of_sight",
    "match_least_squares",
    "measure_boards",
    "pixel_from_image",
    "read_photograph",
    "rim_centre_shift",
    "ring_codes",
]
