"""Refinement of scanner images, alone or with photographs, by least squares."""

from jaxbundle.refinement.adjusted_tables import adjusted_photographs as adjusted_photographs
from jaxbundle.refinement.adjusted_tables import point_rows as point_rows
from jaxbundle.refinement.freedom import FREE as FREE
from jaxbundle.refinement.freedom import HELD as HELD
from jaxbundle.refinement.freedom import Freedom as Freedom
from jaxbundle.refinement.refining import UNIT_OF_WEIGHT as UNIT_OF_WEIGHT
from jaxbundle.refinement.refining import Refinement as Refinement
from jaxbundle.refinement.refining import refine as refine
from jaxbundle.refinement.report import report as report
from jaxbundle.refinement.report import to_json as to_json
from jaxbundle.refinement.tables import GroundPoints as GroundPoints
from jaxbundle.refinement.tables import ScannerImage as ScannerImage
from jaxbundle.refinement.tables import local_points as local_points
