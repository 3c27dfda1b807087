"""Image measurement: targets, boards, fiducial marks, correlation; from pixels to points.

Pixel (0, 0) is the centre of the upper-left pixel, u to the right, v down; a photograph is an array
[rows, columns] of grey values.
"""

from jaxbundle.measure.board_points import BoardPoints as BoardPoints
from jaxbundle.measure.boards import Board as Board
from jaxbundle.measure.clouds import filter_cloud as filter_cloud
from jaxbundle.measure.corners import find_board as find_board
from jaxbundle.measure.corners import find_board_points as find_board_points
from jaxbundle.measure.ellipses import Ellipse as Ellipse
from jaxbundle.measure.ellipses import circle_centre_shift as circle_centre_shift
from jaxbundle.measure.ellipses import fit_ellipse as fit_ellipse
from jaxbundle.measure.ellipses import rim_centre_shift as rim_centre_shift
from jaxbundle.measure.fiducials import Transformation as Transformation
from jaxbundle.measure.fiducials import fit_fiducials as fit_fiducials
from jaxbundle.measure.least_squares_matching import LeastSquaresMatch as LeastSquaresMatch
from jaxbundle.measure.least_squares_matching import MatchingStatus as MatchingStatus
from jaxbundle.measure.least_squares_matching import grey_value as grey_value
from jaxbundle.measure.least_squares_matching import match_least_squares as match_least_squares
from jaxbundle.measure.matching import Match as Match
from jaxbundle.measure.matching import correlation as correlation
from jaxbundle.measure.matching import find_match as find_match
from jaxbundle.measure.targets import Target as Target
from jaxbundle.measure.targets import centre_by_ellipse as centre_by_ellipse
from jaxbundle.measure.targets import centre_by_grey_values as centre_by_grey_values
from jaxbundle.measure.transfer import View as View
from jaxbundle.measure.transfer import ground_point as ground_point
from jaxbundle.measure.transfer import image_point as image_point
from jaxbundle.measure.transfer import image_to_image as image_to_image
from jaxbundle.measure.transfer import line_of_sight as line_of_sight
from jaxbundle.measure.views import BoardViews as BoardViews
from jaxbundle.measure.views import measure_boards as measure_boards
from jaxbundle.network.units import image_from_pixel as image_from_pixel
from jaxbundle.network.units import pixel_from_image as pixel_from_image
from jaxbundle.photographs import read_photograph as read_photograph
