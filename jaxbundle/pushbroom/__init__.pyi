# Written by `make stubs` from the names in __init__.py.
# ruff: noqa: I001
from jaxbundle.commands.corrected_maps import CorrectedImage as CorrectedImage
from jaxbundle.commands.corrected_maps import correct as correct
from jaxbundle.commands.scanner_images import refine as refine
from jaxbundle.commands.scanner_images import simulate as simulate
from jaxbundle.commands.scanner_info import ScannerInfo as ScannerInfo
from jaxbundle.commands.scanner_info import info as info
from jaxbundle.commands.scanner_tables import ScannerTable as ScannerTable
from jaxbundle.commands.scanner_tables import accuracy as accuracy
from jaxbundle.commands.scanner_tables import locate as locate
from jaxbundle.commands.scanner_tables import project as project
from jaxbundle.commands.scanner_ties import tie as tie
from jaxbundle.pushbroom import rpc as rpc
from jaxbundle.pushbroom.ancillary import attitude_table as attitude_table
from jaxbundle.pushbroom.ancillary import position_table as position_table
from jaxbundle.pushbroom.corrections import Corrections as Corrections
from jaxbundle.pushbroom.earth_frames import EarthOrientation as EarthOrientation
from jaxbundle.pushbroom.earth_frames import circular_orbit as circular_orbit
from jaxbundle.pushbroom.earth_frames import to_earth as to_earth
from jaxbundle.pushbroom.earth_frames import turn_positions as turn_positions
from jaxbundle.pushbroom.earth_frames import turn_quaternions as turn_quaternions
from jaxbundle.pushbroom.earth_frames import two_line_orbit as two_line_orbit
from jaxbundle.pushbroom.error_propagation import closed_form as closed_form
from jaxbundle.pushbroom.error_propagation import ground_errors as ground_errors
from jaxbundle.pushbroom.error_propagation import propagate_accuracy as propagate_accuracy
from jaxbundle.pushbroom.error_propagation import simulate_accuracy as simulate_accuracy
from jaxbundle.pushbroom.error_propagation import spread_positions as spread_positions
from jaxbundle.pushbroom.flight import Flight as Flight
from jaxbundle.pushbroom.flight import measured_image as measured_image
from jaxbundle.pushbroom.flight import take_image as take_image
from jaxbundle.pushbroom.flight import true_image as true_image
from jaxbundle.pushbroom.ground_to_image import Projected as Projected
from jaxbundle.pushbroom.ground_to_image import ProjectionStatus as ProjectionStatus
from jaxbundle.pushbroom.ground_to_image import make_search as make_search
from jaxbundle.pushbroom.ground_to_image import project_from as project_from
from jaxbundle.pushbroom.ground_to_image import project_near as project_near
from jaxbundle.pushbroom.ground_to_image import project_points as project_points
from jaxbundle.pushbroom.image import Offsets as Offsets
from jaxbundle.pushbroom.image import PushbroomImage as PushbroomImage
from jaxbundle.pushbroom.image import make_image as make_image
from jaxbundle.pushbroom.image import pose_at as pose_at
from jaxbundle.pushbroom.image_to_ground import locate_lines as locate_lines
from jaxbundle.pushbroom.image_to_ground import locate_point as locate_point
from jaxbundle.pushbroom.image_to_ground import locate_points as locate_points
from jaxbundle.pushbroom.map_accuracy import MapErrors as MapErrors
from jaxbundle.pushbroom.map_accuracy import covariance_lattice as covariance_lattice
from jaxbundle.pushbroom.noise import Noise as Noise
from jaxbundle.pushbroom.noise import add_errors as add_errors
from jaxbundle.pushbroom.orbit import state_orbit as state_orbit
from jaxbundle.pushbroom.rectification import BLOCK_SIZE as BLOCK_SIZE
from jaxbundle.pushbroom.rectification import NODE_STEP as NODE_STEP
from jaxbundle.pushbroom.rectification import block_places as block_places
from jaxbundle.pushbroom.resampling import resample as resample
from jaxbundle.pushbroom.rpc.agreement import Agreement as Agreement
from jaxbundle.pushbroom.rpc.agreement import compare_with_rpc as compare_with_rpc
from jaxbundle.pushbroom.rpc.bias import apply_bias as apply_bias
from jaxbundle.pushbroom.rpc.bias import fit_bias as fit_bias
from jaxbundle.pushbroom.rpc.fitting import RpcCheck as RpcCheck
from jaxbundle.pushbroom.rpc.fitting import RpcFit as RpcFit
from jaxbundle.pushbroom.rpc.fitting import RpcTable as RpcTable
from jaxbundle.pushbroom.rpc.fitting import check_rpc as check_rpc
from jaxbundle.pushbroom.rpc.fitting import fit_image as fit_image
from jaxbundle.pushbroom.rpc.fitting import fit_rpc as fit_rpc
from jaxbundle.pushbroom.rpc.image import RpcImage as RpcImage
from jaxbundle.pushbroom.rpc.polynomials import Rpc as Rpc
from jaxbundle.pushbroom.rpc.polynomials import RpcStatus as RpcStatus
from jaxbundle.pushbroom.scanner import AnglePolynomial as AnglePolynomial
from jaxbundle.pushbroom.scanner import AngleTable as AngleTable
from jaxbundle.pushbroom.scanner import FocalLine as FocalLine
from jaxbundle.pushbroom.scanner import LineTimes as LineTimes
from jaxbundle.pushbroom.search_settings import SearchSettings as SearchSettings
from jaxbundle.pushbroom.study import AccuracyTable as AccuracyTable
from jaxbundle.pushbroom.study import accuracy_table as accuracy_table
from jaxbundle.pushbroom.surfaces import Ground as Ground
from jaxbundle.pushbroom.surfaces import Height as Height
from jaxbundle.pushbroom.surfaces import Plane as Plane
from jaxbundle.pushbroom.terrain import Terrain as Terrain
from jaxbundle.pushbroom.terrain import make_terrain as make_terrain
from jaxbundle.pushbroom.trajectory import Trajectory as Trajectory

__all__ = [
    "AccuracyTable",
    "Agreement",
    "AnglePolynomial",
    "AngleTable",
    "BLOCK_SIZE",
    "CorrectedImage",
    "Corrections",
    "EarthOrientation",
    "Flight",
    "FocalLine",
    "Ground",
    "Height",
    "LineTimes",
    "MapErrors",
    "NODE_STEP",
    "Noise",
    "Offsets",
    "Plane",
    "Projected",
    "ProjectionStatus",
    "PushbroomImage",
    "Rpc",
    "RpcCheck",
    "RpcFit",
    "RpcImage",
    "RpcStatus",
    "RpcTable",
    "ScannerInfo",
    "ScannerTable",
    "SearchSettings",
    "Terrain",
    "Trajectory",
    "accuracy",
    "accuracy_table",
    "add_errors",
    "apply_bias",
    "attitude_table",
    "block_places",
    "check_rpc",
    "circular_orbit",
    "closed_form",
    "compare_with_rpc",
    "correct",
    "covariance_lattice",
    "fit_bias",
    "fit_image",
    "fit_rpc",
    "ground_errors",
    "info",
    "locate",
    "locate_lines",
    "locate_point",
    "locate_points",
    "make_image",
    "make_search",
    "make_terrain",
    "measured_image",
    "pose_at",
    "position_table",
    "project",
    "project_from",
    "project_near",
    "project_points",
    "propagate_accuracy",
    "refine",
    "resample",
    "simulate",
    "simulate_accuracy",
    "spread_positions",
    "state_orbit",
    "take_image",
    "tie",
    "to_earth",
    "true_image",
    "turn_positions",
    "turn_quaternions",
    "two_line_orbit",
]
