# Written by `make stubs` from the names in __init__.py.
# ruff: noqa: I001
from jaxbundle.commands.rpc import ScannerRpc as ScannerRpc
from jaxbundle.commands.rpc import apply as apply
from jaxbundle.commands.rpc import compensate as compensate
from jaxbundle.commands.rpc import fit as fit
from jaxbundle.pushbroom.rpc.polynomials import Rpc as Rpc
from jaxbundle.pushbroom.rpc.polynomials import RpcStatus as RpcStatus
from jaxbundle.pushbroom.rpc.polynomials import domain as domain
from jaxbundle.pushbroom.rpc.polynomials import locate as locate
from jaxbundle.pushbroom.rpc.polynomials import locate_on as locate_on
from jaxbundle.pushbroom.rpc.polynomials import locate_points as locate_points
from jaxbundle.pushbroom.rpc.polynomials import locate_points_on as locate_points_on
from jaxbundle.pushbroom.rpc.polynomials import project as project
from jaxbundle.pushbroom.rpc.polynomials import project_points as project_points

__all__ = [
    "Rpc",
    "RpcStatus",
    "ScannerRpc",
    "apply",
    "compensate",
    "domain",
    "fit",
    "locate",
    "locate_on",
    "locate_points",
    "locate_points_on",
    "project",
    "project_points",
]
