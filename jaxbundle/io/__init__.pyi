# Written by `make stubs` from the names in __init__.py.
# ruff: noqa: I001
from jaxbundle.io import boards as boards
from jaxbundle.io import cameras as cameras
from jaxbundle.io import networks as networks
from jaxbundle.io import rasters as rasters
from jaxbundle.io import results as results
from jaxbundle.io import scanner as scanner
from jaxbundle.io import text as text
from jaxbundle.io import writing as writing
from jaxbundle.io.boards.board_sets import BoardFile as BoardFile
from jaxbundle.io.boards.board_sets import read_boards as read_boards
from jaxbundle.io.boards.corners import read_corners as read_corners
from jaxbundle.io.boards.corners import write_corners as write_corners
from jaxbundle.io.boards.targets import read_target as read_target
from jaxbundle.io.boards.targets import write_target as write_target
from jaxbundle.io.cameras.camera_files import read_cameras as read_cameras
from jaxbundle.io.cameras.camera_files import write_cameras as write_cameras
from jaxbundle.io.cameras.opencv_file import read_opencv as read_opencv
from jaxbundle.io.cameras.opencv_writing import write_opencv as write_opencv
from jaxbundle.io.cameras.opencv_writing import write_ros as write_ros
from jaxbundle.io.exchange import Converted as Converted
from jaxbundle.io.exchange import convert as convert
from jaxbundle.io.formats import FORMATS as FORMATS
from jaxbundle.io.formats import Format as Format
from jaxbundle.io.formats import read_network as read_network
from jaxbundle.io.networks.alicevision_writing import write_alicevision as write_alicevision
from jaxbundle.io.networks.bal import write_bal as write_bal
from jaxbundle.io.networks.bundler import write_bundler as write_bundler
from jaxbundle.io.networks.colmap import write_colmap as write_colmap
from jaxbundle.io.networks.colmap import write_colmap_cameras as write_colmap_cameras
from jaxbundle.io.networks.jaicov import write_jaicov as write_jaicov
from jaxbundle.io.networks.kalibr import write_kalibr as write_kalibr
from jaxbundle.io.networks.micmac import write_micmac as write_micmac
from jaxbundle.io.networks.micmac_camera import write_autocal as write_autocal
from jaxbundle.io.networks.mrcal import write_cameramodel as write_cameramodel
from jaxbundle.io.networks.mrcal import write_mrcal as write_mrcal
from jaxbundle.io.networks.openmvg import write_openmvg as write_openmvg
from jaxbundle.io.networks.opensfm_objects import from_opensfm as from_opensfm
from jaxbundle.io.networks.opensfm_writing import write_opensfm as write_opensfm
from jaxbundle.io.networks.photo_list import read_photo_list as read_photo_list
from jaxbundle.io.networks.project import read_project as read_project
from jaxbundle.io.networks.project import write_project as write_project
from jaxbundle.io.networks.pycolmap_objects import from_pycolmap as from_pycolmap
from jaxbundle.io.networks.pycolmap_objects import to_pycolmap as to_pycolmap
from jaxbundle.io.networks.realityscan import write_realityscan_csv as write_realityscan_csv
from jaxbundle.io.networks.realityscan import write_realityscan_xmp as write_realityscan_xmp
from jaxbundle.io.networks.transforms import write_transforms as write_transforms
from jaxbundle.io.output_formats import OutputFormat as OutputFormat
from jaxbundle.io.output_formats import TARGETS as TARGETS
from jaxbundle.io.rasters.correction import map_of as map_of
from jaxbundle.io.rasters.maps import MapGrid as MapGrid
from jaxbundle.io.rasters.maps import MapSystem as MapSystem
from jaxbundle.io.results.coordinates import write_coordinates as write_coordinates
from jaxbundle.io.results.dxf import write_dxf as write_dxf
from jaxbundle.io.results.gis import write_geojson as write_geojson
from jaxbundle.io.results.gis import write_geopackage as write_geopackage
from jaxbundle.io.results.ply import write_ply as write_ply
from jaxbundle.io.results.result_project import adjusted_network as adjusted_network
from jaxbundle.io.results.result_project import readjustable_network as readjustable_network
from jaxbundle.io.scanner.csm_writing import StateFit as StateFit
from jaxbundle.io.scanner.csm_writing import write_csm_state as write_csm_state
from jaxbundle.io.scanner.flight import FlightFile as FlightFile
from jaxbundle.io.scanner.flight import read_flight as read_flight
from jaxbundle.io.scanner.read import read_scanner as read_scanner
from jaxbundle.io.scanner.refinement import RefineFile as RefineFile
from jaxbundle.io.scanner.refinement import read_refinement as read_refinement
from jaxbundle.io.scanner.rpc import StatedErrors as StatedErrors
from jaxbundle.io.scanner.rpc import read_rpc as read_rpc
from jaxbundle.io.scanner.rpc import read_stated_errors as read_stated_errors
from jaxbundle.io.scanner.rpc import write_rpc as write_rpc

__all__ = [
    "BoardFile",
    "Converted",
    "FORMATS",
    "FlightFile",
    "Format",
    "MapGrid",
    "MapSystem",
    "OutputFormat",
    "RefineFile",
    "StateFit",
    "StatedErrors",
    "TARGETS",
    "adjusted_network",
    "convert",
    "from_opensfm",
    "from_pycolmap",
    "map_of",
    "read_boards",
    "read_cameras",
    "read_corners",
    "read_flight",
    "read_network",
    "read_opencv",
    "read_photo_list",
    "read_project",
    "read_refinement",
    "read_rpc",
    "read_scanner",
    "read_stated_errors",
    "read_target",
    "readjustable_network",
    "to_pycolmap",
    "write_alicevision",
    "write_autocal",
    "write_bal",
    "write_bundler",
    "write_cameramodel",
    "write_cameras",
    "write_colmap",
    "write_colmap_cameras",
    "write_coordinates",
    "write_corners",
    "write_csm_state",
    "write_dxf",
    "write_geojson",
    "write_geopackage",
    "write_jaicov",
    "write_kalibr",
    "write_micmac",
    "write_mrcal",
    "write_opencv",
    "write_openmvg",
    "write_opensfm",
    "write_ply",
    "write_project",
    "write_realityscan_csv",
    "write_realityscan_xmp",
    "write_ros",
    "write_rpc",
    "write_target",
    "write_transforms",
]
