"""Reading and writing networks and cameras (the formats are listed in docs/exchange.md)."""

from jaxbundle.lazy import import_on_use

# By module; __init__.pyi has their types, for editors and type checkers: `make stubs` writes it.
_HOME = {
    "jaxbundle.io.boards.board_sets": ("BoardFile", "read_boards"),
    "jaxbundle.io.boards.corners": ("read_corners", "write_corners"),
    "jaxbundle.io.boards.targets": ("read_target", "write_target"),
    "jaxbundle.io.cameras.camera_files": ("read_cameras", "write_cameras"),
    "jaxbundle.io.cameras.opencv_file": ("read_opencv",),
    "jaxbundle.io.cameras.opencv_writing": ("write_opencv", "write_ros"),
    "jaxbundle.io.exchange": ("Converted", "convert"),
    "jaxbundle.io.formats": ("FORMATS", "TARGETS", "Format", "OutputFormat", "read_network"),
    "jaxbundle.io.networks.alicevision_writing": ("write_alicevision",),
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
    "jaxbundle.io.networks.pycolmap_objects": ("from_pycolmap", "to_pycolmap"),
    "jaxbundle.io.networks.realityscan": ("write_realityscan_csv", "write_realityscan_xmp"),
    "jaxbundle.io.networks.transforms": ("write_transforms",),
    "jaxbundle.io.results.coordinates": ("write_coordinates",),
    "jaxbundle.io.results.dxf": ("write_dxf",),
    "jaxbundle.io.results.gis": ("write_geojson", "write_geopackage"),
    "jaxbundle.io.results.ply": ("write_ply",),
    "jaxbundle.io.rasters.correction": ("map_of",),
    "jaxbundle.io.scanner.csm_writing": ("StateFit", "write_csm_state"),
    "jaxbundle.io.rasters.maps": ("MapGrid", "MapSystem"),
    "jaxbundle.io.scanner.flight": ("FlightFile", "read_flight"),
    "jaxbundle.io.scanner.read": ("read_scanner",),
    "jaxbundle.io.scanner.refinement": ("RefineFile", "read_refinement"),
    "jaxbundle.io.scanner.rpc": ("read_rpc", "write_rpc"),
    "jaxbundle.io.results.result_project": ("adjusted_network", "readjustable_network"),
}
__getattr__, __dir__, __all__ = import_on_use(globals(), _HOME)
