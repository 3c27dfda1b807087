"""Photographs as files: pixels, and metadata on camera, position and time."""

from jaxbundle.photographs.exif import Exif, read_exif
from jaxbundle.photographs.reading import photograph_size, read_photograph
from jaxbundle.photographs.video import FrameSettings

__all__ = [
    "Exif",
    "FrameSettings",
    "photograph_size",
    "read_exif",
    "read_photograph",
]
