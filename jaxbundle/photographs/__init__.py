"""Photographs as files: pixels, and what their files say of camera, place and time."""

from .exif import Exif as Exif
from .exif import read_exif as read_exif
from .reading import photograph_size as photograph_size
from .reading import read_photograph as read_photograph
