"""Camera calibration from photographs of a board, and its accuracy."""

from jaxbundle.calibration.calibrate import calibrate as calibrate
from jaxbundle.calibration.choice import ModelComparison as ModelComparison
from jaxbundle.calibration.choice import compare_models as compare_models
from jaxbundle.calibration.files import write_calibration as write_calibration
from jaxbundle.calibration.files import write_calibrations as write_calibrations
from jaxbundle.calibration.result import Calibration as Calibration
from jaxbundle.calibration.rig.calibrate import calibrate_rig as calibrate_rig
from jaxbundle.calibration.rig.result import RigCalibration as RigCalibration
from jaxbundle.calibration.several import Calibrations as Calibrations
from jaxbundle.calibration.several import calibrate_cameras as calibrate_cameras
from jaxbundle.calibration.simulate import simulate_views as simulate_views
from jaxbundle.measure import Board as Board
from jaxbundle.measure.views import BoardViews as BoardViews
