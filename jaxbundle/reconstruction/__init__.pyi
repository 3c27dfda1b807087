# Written by `make stubs` from the names in __init__.py.
# ruff: noqa: I001
from jaxbundle.reconstruction.result import ReconstructedPart as ReconstructedPart
from jaxbundle.reconstruction.result import Reconstruction as Reconstruction
from jaxbundle.reconstruction.settings import ReconstructionSettings as ReconstructionSettings

__all__ = [
    "ReconstructedPart",
    "Reconstruction",
    "ReconstructionSettings",
]
