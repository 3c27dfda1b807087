"""Reconstruction: from photographs to an adjusted network."""

from jaxbundle.lazy import import_on_use

# By module; __init__.pyi has their types: `make stubs` writes it.
_HOME = {
    "jaxbundle.reconstruction.result": (
        "ReconstructedPart",
        "Reconstruction",
    ),
    "jaxbundle.reconstruction.settings": ("ReconstructionSettings",),
}
__getattr__, __dir__, __all__ = import_on_use(globals(), _HOME)
