"""Refinement of scanner images, alone or with photographs, by least squares."""

from .adjusted import adjusted_photographs as adjusted_photographs
from .adjusted import point_rows as point_rows
from .freedom import FREE as FREE
from .freedom import HELD as HELD
from .freedom import Freedom as Freedom
from .refining import Refinement as Refinement
from .refining import refine as refine
from .report import report as report
from .report import to_json as to_json
from .tables import GroundPoints as GroundPoints
from .tables import ScannerImage as ScannerImage
from .tables import local_points as local_points
