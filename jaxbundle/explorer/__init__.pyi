# Written by `make stubs` from the names in __init__.py.
# ruff: noqa: I001
from jaxbundle.explorer import page as page
from jaxbundle.explorer.camera import CameraView as CameraView
from jaxbundle.explorer.network import NetworkView as NetworkView
from jaxbundle.explorer.scanner import FlightView as FlightView
from jaxbundle.explorer.server import Server as Server
from jaxbundle.explorer.view import ExplorerView as ExplorerView
from jaxbundle.explorer.widget import show as show

__all__ = [
    "CameraView",
    "ExplorerView",
    "FlightView",
    "NetworkView",
    "Server",
    "show",
]
