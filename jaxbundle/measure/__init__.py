"""Image measurement: targets, boards, fiducial marks, correlation; from pixels to points.

Pixel (0, 0) is the centre of the upper-left pixel, u to the right, v down; a photograph is an array
[rows, columns] of grey values.
"""

from .boards import Board as Board
from .corners import find_board as find_board
from .ellipses import Ellipse as Ellipse
from .ellipses import circle_centre_shift as circle_centre_shift
from .ellipses import fit_ellipse as fit_ellipse
from .photographs import read_photograph as read_photograph
from .targets import Target as Target
from .targets import centre_by_ellipse as centre_by_ellipse
from .targets import centre_by_grey_values as centre_by_grey_values
