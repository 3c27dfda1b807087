"""Refinement of scanner images, alone or with photographs, by least squares."""

from jaxbundle.refinement.adjusted_tables import adjusted_photographs, point_rows
from jaxbundle.refinement.freedom import FREE, HELD, Freedom
from jaxbundle.refinement.refining import Refinement, refine
from jaxbundle.refinement.report import report, to_json
from jaxbundle.refinement.tables import UNIT_OF_WEIGHT, GroundPoints, ScannerImage, local_points

__all__ = [
    "FREE",
    "Freedom",
    "GroundPoints",
    "HELD",
    "Refinement",
    "ScannerImage",
    "UNIT_OF_WEIGHT",
    "adjusted_photographs",
    "local_points",
    "point_rows",
    "refine",
    "report",
    "to_json",
]
