"""Photographs as files: pixels, and metadata on camera, position and time."""

from .exif import Exif as Exif
from .exif import read_exif as read_exif
from .reading import photograph_size as photograph_size
from .reading import read_photograph as read_photograph
