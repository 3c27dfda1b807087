"""Corners of black and light squares, refined in windows without other corners by OpenCV's
`cornerSubPix`: the point to which all grey-value gradients around it are perpendicular (Förstner
and Gülch, 1987)."""

import numpy as np
from jaxtyping import Float, UInt8

from jaxbundle.photographs.opencv import need_opencv

Grey = UInt8[np.ndarray, "rows columns"]

WINDOW = 0.35
"""Half a window relative to the distance to the next corner: no other corner is in it."""
SMALLEST, LARGEST = 2, 15
"""Limits of half a window, in pixels."""


def half_window(distance: float, free: float = np.inf) -> int:
    """Half a window, in pixels; `free`: the part of the distance to the next corner without other
    edges."""
    return int(np.clip(min(WINDOW, free) * distance, SMALLEST, LARGEST))


def refine_by_gradients(
    grey: Grey, xy: Float[np.ndarray, "n 2"], half: int
) -> Float[np.ndarray, "n 2"]:
    """Refined corners, pixels, in windows of 2·half + 1 pixels."""
    cv2 = need_opencv()
    corners = np.ascontiguousarray(xy, np.float32).reshape(-1, 1, 2)
    stop = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 100, 1e-5)
    refined = cv2.cornerSubPix(grey, corners, (half, half), (-1, -1), stop).reshape(-1, 2)
    return refined.astype(float)
