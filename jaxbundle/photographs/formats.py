"""Formats of photographs by suffix and content: those that are read, and what to do about others.

HEIC is read if `pillow-heif` is installed, AVIF if Pillow was built with it.
"""

import importlib
from pathlib import Path

# Suffixes of photographs that OpenCV or Pillow reads.
SUFFIXES = (
    ".jpg",
    ".jpeg",
    ".jpe",
    ".jfif",
    ".tif",
    ".tiff",
    ".png",
    ".webp",
    ".bmp",
    ".jp2",
    ".ppm",
    ".pgm",
)
HEIC = (".heic", ".heif", ".hif")
RAW = (
    ".dng", ".cr2", ".cr3", ".crw", ".nef", ".nrw", ".arw", ".srf", ".sr2", ".raf", ".orf", ".rw2",
    ".rwl", ".pef", ".srw", ".x3f", ".3fr", ".iiq", ".erf", ".kdc", ".mrw", ".gpr", ".raw",
)  # fmt: skip
# Some of them are read by Pillow, depending on how it was built.
OTHERS = (".avif", ".jxl", ".psd", ".exr", ".jxr")

OF_HEIC = (
    "HEIC is read after pip install pillow-heif; or convert it to JPEG with its metadata "
    "(heif-convert, sips on macOS, or let the telephone save JPEG)"
)
OF_RAW = (
    "raw files are not read: develop them to JPEG or TIFF, without correction of distortion, with "
    "the program of the camera's maker, darktable or RawTherapee"
)
OF_OTHERS = "this format is not read: convert it to JPEG or TIFF, with its metadata"
# By the brand in the header of an ISO media file: photographs are also named .jpg wrongly.
BRANDS = {
    b"heic": OF_HEIC,
    b"heix": OF_HEIC,
    b"mif1": OF_HEIC,
    b"hevc": OF_HEIC,
    b"avif": OF_OTHERS,
    b"crx ": OF_RAW,
}


def is_photograph(path: Path) -> bool:
    """Whether a file is a photograph, or a raw file by its suffix, read or not."""
    return path.suffix.lower() in (*SUFFIXES, *HEIC, *RAW, *OTHERS)


def remedy(path: str | Path) -> str:
    """What to do about a photograph that cannot be read; empty if its format is not known."""
    suffix = Path(path).suffix.lower()
    for suffixes, words in ((HEIC, OF_HEIC), (RAW, OF_RAW), (OTHERS, OF_OTHERS)):
        if suffix in suffixes:
            return words
    try:
        with open(path, "rb") as file:
            head = file.read(12)
    except OSError:
        return ""
    # An ISO media file begins with a box of type ftyp, whose first field is its brand.
    return BRANDS.get(head[8:12], "") if head[4:8] == b"ftyp" else ""


def register_heic() -> None:
    """Let Pillow read HEIC, if `pillow-heif` is installed."""
    try:
        plugin = importlib.import_module("pillow_heif")
    except ImportError:
        return
    plugin.register_heif_opener()
