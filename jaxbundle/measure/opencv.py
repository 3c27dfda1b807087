"""OpenCV (extra `images`), where it is needed."""

from jaxbundle.errors import InputError


def need_opencv():
    """The module cv2, or what to install."""
    try:
        import cv2
    except ImportError:
        raise InputError(
            "photographs and boards need OpenCV: pip install 'jaxbundle[images]'"
        ) from None
    return cv2
