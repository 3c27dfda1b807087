"""Reading and writing networks and cameras (the formats are listed in docs/exchange.md)."""

from jaxbundle.io.cameras.camera_files import read_cameras as read_cameras
from jaxbundle.io.cameras.camera_files import write_cameras as write_cameras
from jaxbundle.io.cameras.opencv_file import read_opencv as read_opencv
from jaxbundle.io.cameras.opencv_file import write_opencv as write_opencv
from jaxbundle.io.exchange import Converted as Converted
from jaxbundle.io.exchange import convert as convert
from jaxbundle.io.formats import FORMATS as FORMATS
from jaxbundle.io.formats import TARGETS as TARGETS
from jaxbundle.io.formats import Format as Format
from jaxbundle.io.formats import Target as Target
from jaxbundle.io.formats import read_network as read_network
from jaxbundle.io.networks.bal import write_bal as write_bal
from jaxbundle.io.networks.bundler import write_bundler as write_bundler
from jaxbundle.io.networks.colmap import write_colmap as write_colmap
from jaxbundle.io.networks.colmap import write_colmap_cameras as write_colmap_cameras
from jaxbundle.io.networks.photo_list import read_photo_list as read_photo_list
from jaxbundle.io.networks.project import read_project as read_project
from jaxbundle.io.networks.project import write_project as write_project
from jaxbundle.io.results.coordinates import write_coordinates as write_coordinates
from jaxbundle.io.results.dxf import write_dxf as write_dxf
from jaxbundle.io.results.ply import write_ply as write_ply
from jaxbundle.io.results.result_project import adjusted_network as adjusted_network
