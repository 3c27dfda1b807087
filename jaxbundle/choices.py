"""The allowed values of command options and function arguments.

They are kept apart from the subpackages that use them, so that the command line can check and list
them without importing JAX.
"""

from typing import Literal, get_args

METHODS = ("levenberg-marquardt", "gauss-newton")
REDUCTIONS = ("dense", "banded", "iterative")
"""Solvers of the reduced system."""
ESTIMATORS = ("huber", "cauchy", "tukey")
"""Robust estimators."""
TESTS = ("pope", "baarda")
"""Tests of data snooping."""
STATED, UNIT, ESTIMATED = SIGMA_ORIGINS = ("stated", "unit", "estimated")
"""Where a priori σ come from: somebody stated them; nobody did, so that they are units of weight;
they were estimated from the residuals of the same measurements."""

CAMERA_MODELS = (
    "brown", "brown-projected", "usgs", "bingo", "opencv", "snavely", "division",
    "kannala-brandt", "kannala-brandt-tangential", "thin-prism-fisheye",
    "rad-tan-thin-prism-fisheye", "fov", "eucm", "double-sphere", "mei", "scaramuzza",
    "equidistant", "stereographic", "equisolid", "orthographic", "equirectangular",
)  # fmt: skip
_DEGREES = r"(\d+(?:\.\d+)?)"
MODEL_FAMILIES = {
    "radial-spline-N-FOV": rf"radial-spline-(\d+)-{_DEGREES}",
    "spline-NXxNY-FOV": rf"spline-(\d+)x(\d+)-{_DEGREES}",
}
"""Camera models whose names contain numbers, and the form of these names."""

FORMATS = (
    "project", "photo-list", "bal", "column-map", "colmap", "bingo", "metashape", "photomodeler",
    "bundler", "openmvg", "opensfm", "transforms", "kalibr", "micmac", "jaicov", "mrcal",
    "opencv-stereo", "ros-stereo", "rig", "rig-line",
)  # fmt: skip
"""Kinds of inputs that are networks."""
TARGETS = (
    "ply", "dxf", "csv", "bundler", "bal", "colmap", "colmap-text", "openmvg", "opensfm",
    "transforms", "kalibr", "micmac", "jaicov", "mrcal", "opencv-stereo", "ros-stereo", "project",
)  # fmt: skip
CAMERA_FILES = (
    "colmap-cameras", "opensfm-cameras", "ros", "cameramodel", "autocal", "opencv", "cameras",
)  # fmt: skip
"""Kinds of outputs: networks, and cameras alone."""

AIMS = ("mean", "worst", "determinant", "reliability")
"""Measures of σ that a design minimises."""
ORDERS = {
    "zero": "zero order: the datum",
    "first": "first order: the configuration",
    "second": "second order: the weights of photographs",
    "third": "third order: further photographs",
}
"""Problems of design, with their names."""
DESIGNED = ("position", "direction", "roll", "targets")
"""Variables of a first-order design."""

BOARDS = ("chessboard", "circles", "asymmetric-circles", "charuco", "aprilgrid")
CODED_TARGETS = ("aruco", "apriltag", "aprilgrid", "charuco", "ring12", "ring14")
DICTIONARIES = (
    *(f"DICT_{n}X{n}_{words}" for n in (4, 5, 6, 7) for words in (50, 100, 250, 1000)),
    "DICT_ARUCO_ORIGINAL", "DICT_ARUCO_MIP_36h12",
    *(f"DICT_APRILTAG_{family}" for family in ("16h5", "25h9", "36h10", "36h11")),
)  # fmt: skip
"""OpenCV's dictionaries of square markers."""
FEATURES = ("sift", "akaze", "orb")
MATCHED_PAIRS = ("auto", "all", "sequence", "place", "alike")
"""Selections of photograph pairs for matching."""

SURFACE_POINTS = ("grid", "edges", "corners")
"""Points matched for a surface."""
CLOUD_FILES = (".csv", ".ply", ".las", ".laz", ".dxf")
CUBE_POINTS = ("mean", "corner", "best")
"""The point that replaces those of a cube."""

Resampling = Literal["nearest", "bilinear", "cubic"]
RESAMPLINGS: tuple[Resampling, ...] = get_args(Resampling)
AttitudeError = Literal["bias", "white"]
ATTITUDE_ERRORS: tuple[AttitudeError, ...] = get_args(AttitudeError)
"""One error per image, or one per record of the attitude table."""
RPC_BIASES = ("shift", "affine")
"""Bias models of coefficients, in the image."""

EXPLORED = ("network", "camera", "scanner")
"""Inputs of the explorer."""

REPLICATION = ("photographs", "points", "runs", "views")
"""How `replicate` forms halves."""
