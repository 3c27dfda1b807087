"""Image measurement: targets, boards, fiducial marks, correlation; from pixels to points.

Pixel (0, 0) is the centre of the upper-left pixel, u to the right, v down; a photograph is an array
[rows, columns] of grey values.
"""

from jaxbundle.network.units import image_from_pixel as image_from_pixel
from jaxbundle.network.units import pixel_from_image as pixel_from_image

from .boards import Board as Board
from .clouds import filter_cloud as filter_cloud
from .corners import find_board as find_board
from .ellipses import Ellipse as Ellipse
from .ellipses import circle_centre_shift as circle_centre_shift
from .ellipses import fit_ellipse as fit_ellipse
from .ellipses import rim_centre_shift as rim_centre_shift
from .fiducials import Transformation as Transformation
from .fiducials import fit_fiducials as fit_fiducials
from .least_squares_matching import LeastSquaresMatch as LeastSquaresMatch
from .least_squares_matching import MatchingStatus as MatchingStatus
from .least_squares_matching import grey_value as grey_value
from .least_squares_matching import match_least_squares as match_least_squares
from .matching import Match as Match
from .matching import correlation as correlation
from .matching import find_match as find_match
from .photographs import read_photograph as read_photograph
from .targets import Target as Target
from .targets import centre_by_ellipse as centre_by_ellipse
from .targets import centre_by_grey_values as centre_by_grey_values
from .transfer import View as View
from .transfer import ground_point as ground_point
from .transfer import image_point as image_point
from .transfer import image_to_image as image_to_image
from .transfer import line_of_sight as line_of_sight
from .views import BoardViews as BoardViews
from .views import measure_boards as measure_boards
