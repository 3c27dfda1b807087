"""The words that options of commands, and arguments of functions, can be.

They stand apart from the rooms that work with them, so that the command line can check and list
them without importing JAX.
"""

from typing import Literal, get_args

METHODS = ("levenberg-marquardt", "gauss-newton")
REDUCTIONS = ("dense", "banded", "iterative")
"""Ways to solve the reduced system."""
ESTIMATORS = ("huber", "cauchy", "tukey")
"""Robust ones."""
TESTS = ("pope", "baarda")
"""Tests of data snooping."""

AIMS = ("mean", "worst", "determinant", "reliability")
"""Measures of the σ that a design makes small."""
ORDERS = {
    "zero": "zero order: the datum", "first": "first order: the configuration",
    "second": "second order: the weights of photographs",
    "third": "third order: further photographs",
}  # fmt: skip
"""Problems of design, with their names."""
DESIGNED = ("position", "direction", "roll", "targets")
"""What a design of first order can move."""

BOARDS = ("chessboard", "circles", "asymmetric-circles", "charuco")
CODED_TARGETS = ("aruco", "apriltag", "aprilgrid", "charuco", "ring12", "ring14")
FEATURES = ("sift", "akaze", "orb")
MATCHED_PAIRS = ("auto", "all", "sequence", "place", "alike")
"""Ways to choose the pairs of photographs that are matched."""

SURFACE_POINTS = ("grid", "edges", "corners")
"""The points that are matched for a surface."""
CLOUD_FILES = (".csv", ".ply", ".las", ".laz", ".dxf")
CUBE_POINTS = ("mean", "corner", "best")
"""The point that stands for those of a cube."""

Resampling = Literal["nearest", "bilinear", "cubic"]
RESAMPLINGS: tuple[Resampling, ...] = get_args(Resampling)
AttitudeError = Literal["bias", "white"]
ATTITUDE_ERRORS: tuple[AttitudeError, ...] = get_args(AttitudeError)
"""One error an image, or one in every row of the table of attitudes."""
RPC_BIASES = ("shift", "affine")
"""Biases of coefficients, in the image."""

EXPLORED = ("network", "camera", "scanner")
"""What can be explored."""
