"""Design of networks by gradient: datum, configuration, weights, the next photograph."""

from jaxbundle.lazy import import_on_use

# By module; __init__.pyi has their types: `make stubs` writes it.
_HOME = {
    "jaxbundle.network_design.aims": ("Aim",),
    "jaxbundle.network_design.conditions": ("Conditions",),
    "jaxbundle.network_design.result": (
        "Design",
        "DesignState",
    ),
    "jaxbundle.network_design.settings": ("DesignSettings",),
}
__getattr__, __dir__, __all__ = import_on_use(globals(), _HOME)
