# Written by `make stubs` from the names in __init__.py.
# ruff: noqa: I001
from jaxbundle.surfaces.bounds import Bounds as Bounds
from jaxbundle.surfaces.cloud import Cloud as Cloud
from jaxbundle.surfaces.cloud_filters import drop_isolated as drop_isolated
from jaxbundle.surfaces.cloud_filters import drop_weak as drop_weak
from jaxbundle.surfaces.cloud_filters import thin as thin
from jaxbundle.surfaces.dsm import Dsm as Dsm
from jaxbundle.surfaces.dsm import DsmSettings as DsmSettings
from jaxbundle.surfaces.dsm import make_dsm as make_dsm
from jaxbundle.surfaces.dsm import write_dsm as write_dsm
from jaxbundle.surfaces.inputs import read_views as read_views
from jaxbundle.surfaces.reconstruct import SurfaceResult as SurfaceResult
from jaxbundle.surfaces.reconstruct import SurfaceSettings as SurfaceSettings
from jaxbundle.surfaces.reconstruct import find_bounds as find_bounds
from jaxbundle.surfaces.reconstruct import ground_bounds as ground_bounds
from jaxbundle.surfaces.reconstruct import reconstruct_surface as reconstruct_surface
from jaxbundle.surfaces.scanner_views import RpcView as RpcView
from jaxbundle.surfaces.scanner_views import ScannerView as ScannerView

__all__ = [
    "Bounds",
    "Cloud",
    "Dsm",
    "DsmSettings",
    "RpcView",
    "ScannerView",
    "SurfaceResult",
    "SurfaceSettings",
    "drop_isolated",
    "drop_weak",
    "find_bounds",
    "ground_bounds",
    "make_dsm",
    "read_views",
    "reconstruct_surface",
    "thin",
    "write_dsm",
]
