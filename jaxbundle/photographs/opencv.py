"""OpenCV and Pillow (extra `images`), imported on demand: modules that a type checker may not
have."""

from typing import Any

from jaxbundle.errors import InputError


def need_opencv() -> Any:
    """The module cv2, or an error that says what to install."""
    try:
        import cv2
    except ImportError:
        raise InputError(
            "photographs and boards need OpenCV: pip install 'jaxbundle[images]'"
        ) from None
    return cv2


def need_pillow() -> Any:
    """The module PIL.Image, or an error that says what to install."""
    try:
        from PIL import Image
    except ImportError:
        raise InputError("image headers need Pillow: pip install 'jaxbundle[images]'") from None
    return Image
