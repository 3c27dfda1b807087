"""Photographs as arrays of grey values.

The pixels are taken as the sensor wrote them: a note in the file that the photograph is to be shown
turned (EXIF orientation) is not obeyed, since turning it would turn the camera's own axes.
"""

import os
from pathlib import Path

import numpy as np
from jaxtyping import UInt8

from jaxbundle.errors import InputError
from jaxbundle.measure.opencv import need_opencv
from jaxbundle.system.file_content import read_content


def read_photograph(path: str | Path) -> UInt8[np.ndarray, "rows columns"]:
    """The grey values of a photograph in any format OpenCV reads, 8 bits.

    **Raises:** `InputError` if there is no such file, it is empty, or not an image.
    """
    cv2 = need_opencv()
    if not os.path.exists(path):
        raise InputError(f"{path}: no such file")
    if os.path.isdir(path):
        raise InputError(f"{path}: is a folder; give its photographs, such as {path}/*.jpg")
    content = np.frombuffer(read_content(path, text=False), np.uint8)
    if not len(content):
        raise InputError(f"{path}: the file is empty")
    try:
        grey = cv2.imdecode(content, cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION)
    except cv2.error as error:
        raise InputError(f"{path}: the image cannot be decoded ({error.err})") from None
    if grey is None:
        raise InputError(f"{path}: not an image that can be read (JPEG, PNG, TIFF, …)")
    return grey
