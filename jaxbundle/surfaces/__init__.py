"""Surfaces from oriented images: matching, clouds with the covariance of every point, DSM."""

from jaxbundle.lazy import import_on_use

# By module; __init__.pyi has their types: `make stubs` writes it.
_HOME = {
    "jaxbundle.surfaces.reconstruct": (
        "SurfaceResult",
        "SurfaceSettings",
        "find_bounds",
        "ground_bounds",
        "reconstruct_surface",
    ),
    "jaxbundle.surfaces.dsm": (
        "Dsm",
        "DsmSettings",
        "make_dsm",
        "write_dsm",
    ),
    "jaxbundle.surfaces.inputs": ("read_views",),
    "jaxbundle.surfaces.scanner_views": (
        "RpcView",
        "ScannerView",
    ),
    "jaxbundle.surfaces.bounds": ("Bounds",),
    "jaxbundle.surfaces.cloud_filters": (
        "drop_isolated",
        "drop_weak",
        "thin",
    ),
    "jaxbundle.surfaces.cloud": ("Cloud",),
}
__getattr__, __dir__, __all__ = import_on_use(globals(), _HOME)
