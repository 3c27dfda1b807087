"""Reading and writing networks and cameras (the formats are listed in docs/exchange.md)."""

from jaxbundle.lazy import import_on_use

TYPE_CHECKING = False

if TYPE_CHECKING:
    from jaxbundle.io.boards.corners import read_corners as read_corners
    from jaxbundle.io.boards.corners import write_corners as write_corners
    from jaxbundle.io.boards.targets import read_target as read_target
    from jaxbundle.io.boards.targets import write_target as write_target
    from jaxbundle.io.cameras.camera_files import read_cameras as read_cameras
    from jaxbundle.io.cameras.camera_files import write_cameras as write_cameras
    from jaxbundle.io.cameras.opencv_file import read_opencv as read_opencv
    from jaxbundle.io.cameras.opencv_file import write_opencv as write_opencv
    from jaxbundle.io.cameras.opencv_file import write_ros as write_ros
    from jaxbundle.io.exchange import Converted as Converted
    from jaxbundle.io.exchange import convert as convert
    from jaxbundle.io.formats import FORMATS as FORMATS
    from jaxbundle.io.formats import TARGETS as TARGETS
    from jaxbundle.io.formats import Format as Format
    from jaxbundle.io.formats import OutputFormat as OutputFormat
    from jaxbundle.io.formats import read_network as read_network
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
    from jaxbundle.io.networks.opensfm import write_opensfm as write_opensfm
    from jaxbundle.io.networks.photo_list import read_photo_list as read_photo_list
    from jaxbundle.io.networks.project import read_project as read_project
    from jaxbundle.io.networks.project import write_project as write_project
    from jaxbundle.io.networks.transforms import write_transforms as write_transforms
    from jaxbundle.io.results.coordinates import write_coordinates as write_coordinates
    from jaxbundle.io.results.dxf import write_dxf as write_dxf
    from jaxbundle.io.results.ply import write_ply as write_ply
    from jaxbundle.io.results.result_project import adjusted_network as adjusted_network
    from jaxbundle.io.results.result_project import readjustable_network as readjustable_network

_HOME = {
    "jaxbundle.io.boards.corners": ("read_corners", "write_corners"),
    "jaxbundle.io.boards.targets": ("read_target", "write_target"),
    "jaxbundle.io.cameras.camera_files": ("read_cameras", "write_cameras"),
    "jaxbundle.io.cameras.opencv_file": ("read_opencv", "write_opencv", "write_ros"),
    "jaxbundle.io.exchange": ("Converted", "convert"),
    "jaxbundle.io.formats": ("FORMATS", "TARGETS", "Format", "OutputFormat", "read_network"),
    "jaxbundle.io.networks.bal": ("write_bal",),
    "jaxbundle.io.networks.bundler": ("write_bundler",),
    "jaxbundle.io.networks.colmap": ("write_colmap", "write_colmap_cameras"),
    "jaxbundle.io.networks.jaicov": ("write_jaicov",),
    "jaxbundle.io.networks.kalibr": ("write_kalibr",),
    "jaxbundle.io.networks.micmac": ("write_micmac",),
    "jaxbundle.io.networks.micmac_camera": ("write_autocal",),
    "jaxbundle.io.networks.mrcal": ("write_cameramodel", "write_mrcal"),
    "jaxbundle.io.networks.openmvg": ("write_openmvg",),
    "jaxbundle.io.networks.opensfm": ("write_opensfm",),
    "jaxbundle.io.networks.photo_list": ("read_photo_list",),
    "jaxbundle.io.networks.project": ("read_project", "write_project"),
    "jaxbundle.io.networks.transforms": ("write_transforms",),
    "jaxbundle.io.results.coordinates": ("write_coordinates",),
    "jaxbundle.io.results.dxf": ("write_dxf",),
    "jaxbundle.io.results.ply": ("write_ply",),
    "jaxbundle.io.results.result_project": ("adjusted_network", "readjustable_network"),
}
__getattr__, __dir__, __all__ = import_on_use(globals(), _HOME)  # pyright: ignore[reportUnsupportedDunderAll]
