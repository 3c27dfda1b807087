# Written by `make stubs` from the names in __init__.py.
# ruff: noqa: I001
from jaxbundle import adjustment as adjustment
from jaxbundle import batches as batches
from jaxbundle import calibration as calibration
from jaxbundle import cameras as cameras
from jaxbundle import certificates as certificates
from jaxbundle import cli as cli
from jaxbundle import commands as commands
from jaxbundle import explorer as explorer
from jaxbundle import geometry as geometry
from jaxbundle import io as io
from jaxbundle import leastsquares as leastsquares
from jaxbundle import measure as measure
from jaxbundle import network as network
from jaxbundle import network_design as network_design
from jaxbundle import orientation as orientation
from jaxbundle import photographs as photographs
from jaxbundle import planning as planning
from jaxbundle import plotting as plotting
from jaxbundle import pushbroom as pushbroom
from jaxbundle import reconstruction as reconstruction
from jaxbundle import refinement as refinement
from jaxbundle import report as report
from jaxbundle import surfaces as surfaces
from jaxbundle import system as system
from jaxbundle import tiepoints as tiepoints
from jaxbundle.adjustment import make_problem as make_problem
from jaxbundle.adjustment import solve as solve
from jaxbundle.adjustment.adjust import adjust as adjust
from jaxbundle.adjustment.compare import AdjustmentComparison as AdjustmentComparison
from jaxbundle.adjustment.error_budget import Budget as Budget
from jaxbundle.adjustment.error_budget import sensitivity as sensitivity
from jaxbundle.adjustment.gradients import check_gradients as check_gradients
from jaxbundle.adjustment.influence import Influence as Influence
from jaxbundle.adjustment.influence import influence as influence
from jaxbundle.adjustment.load_saved import load_adjustment as load_adjustment
from jaxbundle.adjustment.orient import orient as orient
from jaxbundle.adjustment.quality.precision import Precision as Precision
from jaxbundle.adjustment.quality.precision import precision as precision
from jaxbundle.adjustment.quality.precision import redundancy as redundancy
from jaxbundle.adjustment.replicate import Replication as Replication
from jaxbundle.adjustment.replicate import replicate as replicate
from jaxbundle.adjustment.result import Adjustment as Adjustment
from jaxbundle.adjustment.uncertainty_budget import UncertaintyBudget as UncertaintyBudget
from jaxbundle.adjustment.uncertainty_budget import uncertainty_budget as uncertainty_budget
from jaxbundle.batches.calibrate import BatchCalibration as BatchCalibration
from jaxbundle.batches.calibrate import calibrate_batch as calibrate_batch
from jaxbundle.batches.calibrate_rigs import RigBatch as RigBatch
from jaxbundle.batches.calibrate_rigs import calibrate_rigs as calibrate_rigs
from jaxbundle.calibration import Board as Board
from jaxbundle.calibration import BoardViews as BoardViews
from jaxbundle.calibration import Calibration as Calibration
from jaxbundle.calibration import RigCalibration as RigCalibration
from jaxbundle.calibration import WandCalibration as WandCalibration
from jaxbundle.calibration import calibrate as calibrate
from jaxbundle.calibration import calibrate_cameras as calibrate_cameras
from jaxbundle.calibration import calibrate_rig as calibrate_rig
from jaxbundle.calibration import calibrate_wand as calibrate_wand
from jaxbundle.calibration.as_opencv import calibrate_opencv as calibrate_opencv
from jaxbundle.calibration.stability import Stability as Stability
from jaxbundle.cameras import CameraModel as CameraModel
from jaxbundle.certificates.acceptance import Acceptance as Acceptance
from jaxbundle.certificates.acceptance import accept as accept
from jaxbundle.certificates.document import Certificate as Certificate
from jaxbundle.certificates.document import certificate as certificate
from jaxbundle.certificates.lengths import LengthTest as LengthTest
from jaxbundle.certificates.lengths import length_errors as length_errors
from jaxbundle.certificates.positional import PositionalAccuracy as PositionalAccuracy
from jaxbundle.certificates.positional import positional_accuracy as positional_accuracy
from jaxbundle.commands.batch_run import BatchRun as BatchRun
from jaxbundle.commands.batch_run import batch as batch
from jaxbundle.commands.cameras import CameraDescription as CameraDescription
from jaxbundle.commands.cameras import camera as camera
from jaxbundle.commands.clouds import CloudResult as CloudResult
from jaxbundle.commands.clouds import cloud as cloud
from jaxbundle.commands.comparison import CalibrationComparison as CalibrationComparison
from jaxbundle.commands.comparison import compare as compare
from jaxbundle.commands.examples import example as example
from jaxbundle.commands.exploring import explore as explore
from jaxbundle.commands.hand_eye import HandEye as HandEye
from jaxbundle.commands.hand_eye import hand_eye as hand_eye
from jaxbundle.commands.planned_block import PlannedBlock as PlannedBlock
from jaxbundle.commands.planned_block import plan as plan
from jaxbundle.commands.reconstruction import reconstruct as reconstruct
from jaxbundle.commands.stability_of_cameras import stability as stability
from jaxbundle.commands.surface import Surface as Surface
from jaxbundle.commands.surface import surface as surface
from jaxbundle.commands.surface_change import ChangeResult as ChangeResult
from jaxbundle.commands.surface_change import change as change
from jaxbundle.commands.video_frames import VideoFrames as VideoFrames
from jaxbundle.commands.video_frames import frames as frames
from jaxbundle.errors import InputError as InputError
from jaxbundle.errors import NotSolvedError as NotSolvedError
from jaxbundle.float64 import enable_x64 as enable_x64
from jaxbundle.io import convert as convert
from jaxbundle.io import read_network as read_network
from jaxbundle.io import write_project as write_project
from jaxbundle.io.networks.opensfm_objects import from_opensfm as from_opensfm
from jaxbundle.io.networks.pycolmap_objects import from_pycolmap as from_pycolmap
from jaxbundle.io.networks.pycolmap_objects import to_pycolmap as to_pycolmap
from jaxbundle.leastsquares import Data as Data
from jaxbundle.leastsquares import Problem as Problem
from jaxbundle.leastsquares import Values as Values
from jaxbundle.network import Camera as Camera
from jaxbundle.network import Network as Network
from jaxbundle.network.build import add_further as add_further
from jaxbundle.network.build import make_network as make_network
from jaxbundle.network.check import check_network as check_network
from jaxbundle.network_design.aims import Aim as Aim
from jaxbundle.network_design.conditions import Conditions as Conditions
from jaxbundle.network_design.design import design as design
from jaxbundle.network_design.result import Design as Design
from jaxbundle.orientation.network import Oriented as Oriented
from jaxbundle.planning.simulate import simulate as simulate
from jaxbundle.planning.simulate import simulate_with_truth as simulate_with_truth
from jaxbundle.planning.simulate_further import simulate_further as simulate_further
from jaxbundle.planning.stations import aerial_block as aerial_block
from jaxbundle.planning.stations import cloud_of_targets as cloud_of_targets
from jaxbundle.planning.stations import grid_of_targets as grid_of_targets
from jaxbundle.planning.stations import ring_of_stations as ring_of_stations
from jaxbundle.planning.stations import stations_looking_at as stations_looking_at
from jaxbundle.reconstruction.result import Reconstruction as Reconstruction
from jaxbundle.system.cores import use_cores as use_cores
from jaxbundle.system.joined_processes import join_processes as join_processes
from jaxbundle.system.kept_programs import keep_programs as keep_programs
from jaxbundle.system.progress import show_progress as show_progress

__version__: str

__all__ = [
    "Acceptance",
    "Adjustment",
    "AdjustmentComparison",
    "Aim",
    "BatchCalibration",
    "BatchRun",
    "Board",
    "BoardViews",
    "Budget",
    "Calibration",
    "CalibrationComparison",
    "Camera",
    "CameraDescription",
    "CameraModel",
    "Certificate",
    "ChangeResult",
    "CloudResult",
    "Conditions",
    "Data",
    "Design",
    "HandEye",
    "Influence",
    "InputError",
    "LengthTest",
    "Network",
    "NotSolvedError",
    "Oriented",
    "PlannedBlock",
    "PositionalAccuracy",
    "Precision",
    "Problem",
    "Reconstruction",
    "Replication",
    "RigBatch",
    "RigCalibration",
    "Stability",
    "Surface",
    "UncertaintyBudget",
    "Values",
    "VideoFrames",
    "WandCalibration",
    "accept",
    "add_further",
    "adjust",
    "aerial_block",
    "batch",
    "calibrate",
    "calibrate_batch",
    "calibrate_cameras",
    "calibrate_opencv",
    "calibrate_rig",
    "calibrate_rigs",
    "calibrate_wand",
    "camera",
    "certificate",
    "change",
    "check_gradients",
    "check_network",
    "cloud",
    "cloud_of_targets",
    "compare",
    "convert",
    "design",
    "enable_x64",
    "example",
    "explore",
    "frames",
    "from_opensfm",
    "from_pycolmap",
    "grid_of_targets",
    "hand_eye",
    "influence",
    "join_processes",
    "keep_programs",
    "length_errors",
    "load_adjustment",
    "make_network",
    "make_problem",
    "orient",
    "plan",
    "positional_accuracy",
    "precision",
    "read_network",
    "reconstruct",
    "redundancy",
    "replicate",
    "ring_of_stations",
    "sensitivity",
    "show_progress",
    "simulate",
    "simulate_further",
    "simulate_with_truth",
    "solve",
    "stability",
    "stations_looking_at",
    "surface",
    "to_pycolmap",
    "uncertainty_budget",
    "use_cores",
    "write_project",
]
