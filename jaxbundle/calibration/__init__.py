"""Camera calibration from photographs of a board, and its accuracy."""

from jaxbundle.calibration.calibrate import calibrate
from jaxbundle.calibration.files import write_calibration, write_calibrations
from jaxbundle.calibration.model_choice import ModelComparison, compare_models
from jaxbundle.calibration.pixels import images_of_board
from jaxbundle.calibration.result import Calibration
from jaxbundle.calibration.rig.calibrate import calibrate_rig
from jaxbundle.calibration.rig.result import RigCalibration
from jaxbundle.calibration.rig.wand import WandCalibration, calibrate_wand
from jaxbundle.calibration.rig.wand_body import Wand
from jaxbundle.calibration.rig.wand_markers import WandSettings
from jaxbundle.calibration.several import Calibrations, calibrate_cameras
from jaxbundle.calibration.simulate import simulate_views
from jaxbundle.calibration.stability import Stability, stability
from jaxbundle.measure import Board
from jaxbundle.measure.views import BoardViews

__all__ = [
    "Board",
    "BoardViews",
    "Calibration",
    "Calibrations",
    "ModelComparison",
    "RigCalibration",
    "Stability",
    "Wand",
    "WandCalibration",
    "WandSettings",
    "calibrate",
    "calibrate_cameras",
    "calibrate_rig",
    "calibrate_wand",
    "compare_models",
    "images_of_board",
    "simulate_views",
    "stability",
    "write_calibration",
    "write_calibrations",
]
