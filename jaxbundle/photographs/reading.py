"""Photographs as arrays of grey values or colours, 8 bits.

The pixels are used in the orientation of the sensor: EXIF orientation is ignored, since a rotation
would rotate the camera axes. Images with more than 8 bits are stretched to 8 bits.
"""

import io
import os
import threading
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
from jaxtyping import Shaped, UInt8

from jaxbundle.errors import InputError
from jaxbundle.photographs.formats import OF_RAW, RAW, register_heic, remedy
from jaxbundle.photographs.opencv import need_opencv, need_pillow
from jaxbundle.system.file_content import check_plain, read_content
from jaxbundle.system.foreign_parsers import foreign_parser
from jaxbundle.system.memory import free_memory, is_memory_shortage

# Limit of OpenCV (CV_IO_MAX_IMAGE_PIXELS).
MOST_PIXELS = 2**30
# Held while Pillow's limit, which is global, is changed.
LIMIT = threading.Lock()
EXPECTED = "an image (JPEG, PNG, TIFF are read)"
# Marks of JPEG: start of the file, of a scan, end of the image.
START, SCAN, END = b"\xff\xd8", b"\xff\xda", b"\xff\xd9"


class PhotographMemoryError(MemoryError):
    """There is too little memory for a photograph; the message says which, and what to do."""


@contextmanager
def image_errors(path: str | Path | None = None) -> Iterator[None]:
    """Turn the errors of image libraries, in work on a photograph, into those of this package.

    **Arguments:** `path`: of the photograph; None: unknown here, a guard around this one adds it.

    **Raises:** `MemoryError` without memory, which is no fault of the photograph, with what to do
    (`PhotographMemoryError`); `InputError` for any other error of OpenCV.
    """
    try:
        yield
    except (InputError, PhotographMemoryError):
        raise
    except Exception as error:
        if is_memory_shortage(error):
            if path is None:
                raise MemoryError("not enough memory for this image") from None
            raise PhotographMemoryError(_describe_shortage(path)) from None
        if isinstance(error, need_opencv().error):
            where = "" if path is None else f"{path}: "
            words = getattr(error, "err", error)
            raise InputError(f"{where}OpenCV cannot process this image: {words}") from None
        raise


def read_photograph(
    path: str | Path, colour: bool = False
) -> UInt8[np.ndarray, "rows columns"] | UInt8[np.ndarray, "rows columns 3"]:
    """The grey values of a photograph in any format OpenCV reads, or its red, green and blue.

    **Raises:** `InputError` if the file is missing, empty, not an image, truncated, or too
    large; `MemoryError`, which names it, if there is no memory for it.
    """
    with image_errors(path):
        return _read_pixels(need_opencv(), path, colour)


def _read_pixels(
    cv2: ModuleType, path: str | Path, colour: bool
) -> UInt8[np.ndarray, "rows columns *channels"]:
    if not os.path.exists(path):
        raise InputError(f"{path}: no such file")
    if os.path.isdir(path):
        raise InputError(f"{path}: is a folder; give its photographs, such as {path}/*.jpg")
    _refuse_raw(path)
    content = read_content(path, text=False)
    if not len(content):
        raise InputError(f"{path}: the file is empty")
    if _is_truncated(content):
        _refuse_truncated(path, content)
    _refuse_oversized(path, len(content))
    colour_flag = cv2.IMREAD_COLOR if colour else cv2.IMREAD_GRAYSCALE
    flags = colour_flag | cv2.IMREAD_ANYDEPTH | cv2.IMREAD_IGNORE_ORIENTATION
    pixels = cv2.imdecode(np.frombuffer(content, np.uint8), flags)
    if pixels is None:
        pixels = _read_by_pillow(path, content, colour)
    elif colour:
        pixels = pixels[..., ::-1]  # OpenCV's order is blue, green, red
    return np.ascontiguousarray(_stretch(pixels))


def photograph_size(path: str | Path) -> tuple[int, int]:
    """(columns, rows) of a photograph, from the header of its file.

    **Raises:** `InputError` if it is not an image, or has more than 2³⁰ pixels.
    """
    with open_image(path) as image:
        return image.size


def open_image(path: str | Path, content: bytes | None = None) -> Any:
    """The file opened by Pillow with its header read, without decoding pixels. Close it, by `with`.

    **Arguments:** `content`: of the file, if it is in memory.

    **Raises:** `InputError` if it cannot be read, is not an image, or has more than 2³⁰ pixels.
    """
    check_plain(path)
    _refuse_raw(path)
    try:
        with foreign_parser(path, EXPECTED):
            image = _open_any_size(path if content is None else io.BytesIO(content))
    except InputError as error:
        if not os.path.isfile(path) or "cannot be read" in str(error):
            raise
        if not os.path.getsize(path):
            raise InputError(f"{path}: the file is empty") from None
        raise InputError(f"{path}: {remedy(path) or f'not {EXPECTED}'}") from None
    columns, rows = image.size
    if columns * rows > MOST_PIXELS:
        image.close()
        raise InputError(
            f"{path}: {columns} × {rows} pixels; at most {MOST_PIXELS} pixels can be read; reduce "
            "the image"
        )
    return image


def _describe_shortage(path: str | Path) -> str:
    try:
        columns, rows = photograph_size(path)
        size = f" for its {columns} × {rows} pixels"
    except (InputError, MemoryError):
        size = ""
    return (
        f"{path}: not enough memory{size}, {free_memory() / 1e9:.1f} GB are free: raise the limit "
        "(ulimit -v, that of the container), end other programs, or reduce the photographs"
    )


def _refuse_raw(path: str | Path) -> None:
    """Raw files of many cameras are TIFF: a small preview would be read for the photograph."""
    if os.path.exists(path) and os.path.splitext(path)[1].lower() in RAW:
        raise InputError(f"{path}: {OF_RAW}")


def _open_any_size(file: str | Path | io.BytesIO) -> Any:
    """The file opened without Pillow's limit against decompression bombs: 179 million pixels, which
    a photograph may have."""
    Image = need_pillow()
    register_heic()
    with LIMIT:
        limit, Image.MAX_IMAGE_PIXELS = Image.MAX_IMAGE_PIXELS, None
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # about damaged headers: missing fields are unknown
                return Image.open(file)
        finally:
            Image.MAX_IMAGE_PIXELS = limit


def _refuse_oversized(
    path: str | Path, size: int, harmless: int = 2**26, ratio: int = 2000
) -> None:
    """Refuse a header of more pixels than `size` bytes hold; `harmless`: pixels that are always
    decoded; `ratio`: for a byte, beyond them. DEFLATE packs 1032 bytes into one at most, JPEG 512
    pixels of one colour."""
    try:
        columns, rows = photograph_size(path)
    except InputError:
        return  # OpenCV may read what Pillow does not
    if columns * rows > max(harmless, ratio * size):
        raise InputError(
            f"{path}: damaged: {size} bytes that claim to hold {columns} × {rows} pixels"
        )


def _is_truncated(content: bytes) -> bool:
    """Whether a JPEG file has no end mark after its last scan, or a PNG file no end."""
    if content.startswith(START):
        return content.rfind(END) < content.rfind(SCAN)
    # A JPEG preview inside has an end mark of its own, but before the last scan; PNG ends with a
    # chunk IEND of 12 bytes, which padding may follow.
    return content.startswith(b"\x89PNG") and b"IEND" not in content[-64:]


def _refuse_truncated(path: str | Path, content: bytes) -> None:
    """Refuse a file that Pillow cannot decode to its end: the marks alone are no proof."""
    try:
        # Of a file Python makes room for as many bytes as a damaged length says; not of memory.
        with open_image(path, content) as image, foreign_parser(path, EXPECTED, shortage=False):
            image.load()
    except InputError:
        raise InputError(f"{path}: the file is truncated; copy it again") from None


def _read_by_pillow(
    path: str | Path, content: bytes, colour: bool
) -> UInt8[np.ndarray, "rows columns *channels"]:
    with open_image(path, content) as image, foreign_parser(path, EXPECTED, shortage=False):
        return np.asarray(image.convert("RGB" if colour else "L"))


def _stretch(pixels: Shaped[np.ndarray, "*shape"]) -> UInt8[np.ndarray, "*shape"]:
    """Grey values of 8 bits as they are, others in proportion, the brightest 0.2 % as white:
    reflections and hot pixels would otherwise leave a few grey values to the object."""
    if pixels.dtype == np.uint8:
        return pixels
    # Every 64th pixel of a large photograph suffices for a percentile.
    sample = pixels[::8, ::8] if pixels.size > 2**20 else pixels
    white_level = float(np.nanpercentile(sample, 99.8))
    scale = 255 / white_level if white_level > 0 else 1.0
    return np.clip(np.nan_to_num(pixels * scale), 0, 255).astype(np.uint8)
