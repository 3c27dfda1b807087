# Written by `make stubs` from the names in __init__.py.
# ruff: noqa: I001
from jaxbundle.network_design.aims import Aim as Aim
from jaxbundle.network_design.conditions import Conditions as Conditions
from jaxbundle.network_design.result import Design as Design
from jaxbundle.network_design.result import DesignState as DesignState
from jaxbundle.network_design.settings import DesignSettings as DesignSettings

__all__ = [
    "Aim",
    "Conditions",
    "Design",
    "DesignSettings",
    "DesignState",
]
