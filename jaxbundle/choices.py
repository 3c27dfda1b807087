"""The allowed values of command options and function arguments.

They are kept apart from the subpackages that use them, so that the command line can check and list
them without importing JAX.
"""

from typing import Literal, get_args

ANGLE_UNIT_NAMES = ("rad", "deg", "gon")
METHODS = ("levenberg-marquardt", "gauss-newton")
# Solvers of the reduced system.
REDUCTIONS = ("dense", "banded", "iterative")
# Robust estimators.
ESTIMATORS = ("huber", "cauchy", "tukey")
# What the markers of a wand are in an image.
MARKERS_OF_A_WAND = ("bright", "dark")
# Tests of data snooping.
TESTS = ("pope", "baarda")
# Where a priori σ come from: somebody stated them; nobody did, so that they are units of weight;
# they were estimated from the residuals of the same measurements.
STATED, UNIT, ESTIMATED = SIGMA_ORIGINS = ("stated", "unit", "estimated")

CAMERA_MODELS = (
    "brown", "brown-projected", "usgs", "bingo", "opencv", "snavely", "division",
    "kannala-brandt", "kannala-brandt-tangential", "thin-prism-fisheye",
    "rad-tan-thin-prism-fisheye", "fov", "eucm", "double-sphere", "mei", "scaramuzza",
    "equidistant", "stereographic", "equisolid", "orthographic", "equirectangular",
)  # fmt: skip
_DEGREES = r"(\d+(?:\.\d+)?)"
# Camera models whose names contain numbers, and the form of these names.
MODEL_FAMILIES = {
    "radial-spline-N-FOV": rf"radial-spline-(\d+)-{_DEGREES}",
    "spline-NXxNY-FOV": rf"spline-(\d+)x(\d+)-{_DEGREES}",
}

# Kinds of inputs that are networks, and what they look like.
NETWORK_FILES = {
    "project": "a .toml file, or a folder with project.toml",
    "photo-list": "a .txt file whose first line is the focal length",
    "bal": "a text file (.gz, .bz2) whose first line is three numbers",
    "column-map": "a .toml file with [table.…] sections",
    "colmap": "a folder with cameras.bin or cameras.txt",
    "bingo": "a folder with image.dat and geoin.dat",
    "metashape": "an .xml file of Metashape's cameras, or a project, .psx",
    "photomodeler": 'a .txt file that begins with "Bundle Soln"',
    "bundler": 'a file that begins with "# Bundle file"',
    "openmvg": "openMVG's sfm_data.json",
    "opensfm": "OpenSfM's reconstruction.json, or a folder that has it",
    "transforms": "transforms.json of nerfstudio or instant-ngp",
    "kalibr": "a .yaml file of Kalibr with cam0: …",
    "micmac": "a folder of MicMac with Orientation-….xml",
    "jaicov": "a .phc file of AICON, with .ior beside it",
    "mrcal": "a .cameramodel of mrcal, or a folder of them",
    "opencv-stereo": "a .yaml, .json or .xml in OpenCV's style with several cameras: K1, K2, R, T",
    "orb-slam": "a .yaml of ORB-SLAM with two cameras, Camera1.fx … and Camera2.fx …",
    "vins": "a .yaml of VINS-Fusion with cam0_calib and body_T_cam0",
    "euroc": "a folder of EuRoC with cam0/sensor.yaml",
    "ros-stereo": "a folder with two camera_info files of ROS, or ost.txt with two cameras",
    "anipose": "a .toml of anipose, Pose2Sim, FreeMoCap: [cam_0] with matrix, rotation, …",
    "rig": "result.json of jaxbundle calibrate --rig",
    "rig-line": "a line of jaxbundle batch: FILE.jsonl#KEY",
    "csm-frame": "an ISD (.json) of a frame or push-frame camera (CSM), or a frame camera's state",
    "nvm": "an .nvm file of VisualSFM",
    "alicevision": "an .sfm or .json of AliceVision",
    "realityscan": "a folder with .xmp of RealityScan, or its .csv of camera parameters",
    "opf": "an .opf project of the Open Photogrammetry Format (PIX4Dmatic)",
}
# Kinds of inputs that are cameras alone.
CAMERA_INPUTS = {
    "colmap-cameras": "cameras.txt or cameras.bin of COLMAP",
    "cameras": "a .toml with [[camera]] entries",
    "opensfm-cameras": "camera_models.json of OpenSfM",
    "autocal": "AutoCal….xml of MicMac",
    "metashape-lens": "an .xml of Metashape's camera calibration (<calibration><projection>…)",
    "ros-ini": "ost.ini or ost.txt of ROS",
    "slam-yaml": "a .yaml of camodocal or VINS (model_type: …), of ORB-SLAM (Camera.fx: …)",
    "opencv": "a .yaml, .json or .xml of OpenCV, ROS or EuRoC (camera_matrix, K, intrinsics, …)",
}
FORMATS = tuple(NETWORK_FILES)
"""Kinds of inputs that are networks."""
TARGETS = (
    "ply", "dxf", "csv", "bundler", "bal", "colmap", "colmap-text", "openmvg", "opensfm",
    "alicevision", "transforms", "kalibr", "micmac", "jaicov", "mrcal", "opencv-stereo",
    "ros-stereo", "anipose", "realityscan", "realityscan-csv", "project",
)  # fmt: skip
# Kinds of outputs: networks, and cameras alone.
CAMERA_FILES = (
    "colmap-cameras", "opensfm-cameras", "ros", "cameramodel", "autocal", "opencv", "cameras",
)  # fmt: skip

# Measures of σ that a design minimises.
AIMS = ("mean", "worst", "determinant", "reliability")
# Problems of design, with their names.
ORDERS = {
    "zero": "zero order: the datum",
    "first": "first order: the configuration",
    "second": "second order: the weights of photographs",
    "third": "third order: further photographs",
}
# Variables of a first-order design.
DESIGNED = ("position", "direction", "roll", "targets")

# Where the camera of a robot is.
HAND_EYE = ("eye-in-hand", "eye-to-hand")
BOARDS = ("chessboard", "circles", "asymmetric-circles", "charuco", "aprilgrid")
CODED_TARGETS = (
    "aruco",
    "apriltag",
    "aprilgrid",
    "charuco",
    "ring12",
    "ring14",
    "ring16",
    "ring20",
)
# OpenCV's dictionaries of square markers.
DICTIONARIES = (
    *(f"DICT_{n}X{n}_{words}" for n in (4, 5, 6, 7) for words in (50, 100, 250, 1000)),
    "DICT_ARUCO_ORIGINAL", "DICT_ARUCO_MIP_36h12",
    *(f"DICT_APRILTAG_{family}" for family in ("16h5", "25h9", "36h10", "36h11")),
)  # fmt: skip
FEATURES = ("sift", "akaze", "orb")
# Tie points of a reconstruction: of features, or the coded targets alone.
TIE_POINTS = (*FEATURES, "none")
# Selections of photograph pairs for matching.
MATCHED_PAIRS = ("auto", "all", "sequence", "place", "alike")

# Points matched for a surface.
SURFACE_POINTS = ("grid", "edges", "corners")
# What the heights of a surface are above.
ELLIPSOID, GEOID = HEIGHTS = ("ellipsoid", "geoid")
CLOUD_FILES = (".csv", ".ply", ".las", ".laz", ".dxf")
# The point that replaces those of a cube.
CUBE_POINTS = ("mean", "corner", "best")

Resampling = Literal["nearest", "bilinear", "cubic", "lanczos"]
RESAMPLINGS: tuple[Resampling, ...] = get_args(Resampling)
# Of maps in GeoTIFF, without loss.
Compression = Literal["none", "deflate", "lzw", "zstd"]
COMPRESSIONS: tuple[Compression, ...] = get_args(Compression)
# σ that the planimetric σ of a map is propagated from.
MAP_ERRORS = (
    "attitude_bias", "attitude_drift", "attitude_white", "position_bias", "position_drift",
    "position_white", "image", "height", "ground",
)  # fmt: skip
# Stated errors of a surface that is compared with another.
SURFACE_ERRORS = ("cell", "vertical", "horizontal", "tilt")
AttitudeError = Literal["bias", "white"]
# One error per image, or one per record of the attitude table.
ATTITUDE_ERRORS: tuple[AttitudeError, ...] = get_args(AttitudeError)
# Bias models of coefficients, in the image: polynomials of degree 0, 1, 2.
RPC_BIASES = ("shift", "affine", "quadratic")

# Inputs of the explorer.
EXPLORED = ("network", "camera", "scanner")

# How `replicate` forms halves.
REPLICATION = ("photographs", "points", "runs", "views")
