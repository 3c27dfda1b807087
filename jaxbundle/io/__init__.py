"""Reading and writing networks and cameras (the formats are listed in docs/exchange.md)."""

from jaxbundle.io.bal import write_bal as write_bal
from jaxbundle.io.bundler import write_bundler as write_bundler
from jaxbundle.io.camera_files import read_cameras as read_cameras
from jaxbundle.io.camera_files import write_cameras as write_cameras
from jaxbundle.io.colmap import write_colmap as write_colmap
from jaxbundle.io.colmap import write_colmap_cameras as write_colmap_cameras
from jaxbundle.io.coordinates import write_coordinates as write_coordinates
from jaxbundle.io.dxf import write_dxf as write_dxf
from jaxbundle.io.exchange import Converted as Converted
from jaxbundle.io.exchange import convert as convert
from jaxbundle.io.formats import FORMATS as FORMATS
from jaxbundle.io.formats import TARGETS as TARGETS
from jaxbundle.io.formats import Format as Format
from jaxbundle.io.formats import Target as Target
from jaxbundle.io.formats import read_network as read_network
from jaxbundle.io.opencv_file import read_opencv as read_opencv
from jaxbundle.io.opencv_file import write_opencv as write_opencv
from jaxbundle.io.photo_list import read_photo_list as read_photo_list
from jaxbundle.io.ply import write_ply as write_ply
from jaxbundle.io.project import read_project as read_project
from jaxbundle.io.project import write_project as write_project
from jaxbundle.io.result_project import adjusted_network as adjusted_network
