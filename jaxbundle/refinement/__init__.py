"""Refinement of scanner images, alone or with photographs, by least squares."""

from jaxbundle.refinement.adjusted_tables import adjusted_photographs, point_rows
from jaxbundle.refinement.freedom import FREE, HELD, Freedom
from jaxbundle.refinement.refining import Refinement, refine
from jaxbundle.refinement.report import report, to_json
from jaxbundle.refinement.rpc_points import prior_of_bias, prior_of_errors
from jaxbundle.refinement.tables import (
    UNIT_OF_WEIGHT,
    GroundPoints,
    RpcScannerImage,
    ScannerImage,
    local_points,
)
from jaxbundle.refinement.terrain_heights import HeightModel

__all__ = [
    "FREE",
    "Freedom",
    "GroundPoints",
    "HELD",
    "HeightModel",
    "Refinement",
    "RpcScannerImage",
    "ScannerImage",
    "UNIT_OF_WEIGHT",
    "adjusted_photographs",
    "local_points",
    "point_rows",
    "prior_of_bias",
    "prior_of_errors",
    "refine",
    "report",
    "to_json",
]
