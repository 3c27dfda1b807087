"""Selection of points of a base image for matching: every n-th pixel, edges, corners.

Whole pixels, since the windows of least squares matching are centred on a pixel.
"""

import numpy as np
from jaxtyping import Float

from jaxbundle.choices import SURFACE_POINTS
from jaxbundle.errors import InputError
from jaxbundle.photographs.opencv import need_opencv

TILE, SAMPLE = 2048, 1 << 20
"""Side of the tiles of a large image; pixels sampled for the darkest and the brightest."""
WEAKEST_CORNER = 1e-3
"""Minimum eigenvalue of a corner relative to that of the strongest."""


def interest_points(
    grey: Float[np.ndarray, "rows columns"], kind: str, step: int
) -> Float[np.ndarray, "n 2"]:
    """Places (u, v), about `step` pixels apart: on a `grid`, on `edges` (Canny, thresholds by the
    median gradient), on `corners` (Shi and Tomasi, 1994).

    **Raises:** `InputError` for another kind.
    """
    if kind == "grid":
        rows, columns = grey.shape
        v, u = np.mgrid[0:rows:step, 0:columns:step].reshape(2, -1)
        return np.stack([u, v], 1).astype(float)
    if kind not in SURFACE_POINTS:
        raise InputError(f"points {kind!r}: one of {', '.join(SURFACE_POINTS)} is expected")
    every = max(1, grey.size // SAMPLE)
    limits = np.percentile(grey.ravel()[::every], [1, 99])
    find = _corners if kind == "corners" else _edges
    rows, columns = grey.shape
    found = [
        find(_eight_bits(grey[v : v + TILE, u : u + TILE], limits), step) + [u, v]
        for v in range(0, rows, TILE)
        for u in range(0, columns, TILE)
    ]
    return np.concatenate(found)


def _corners(eight, step):
    found = need_opencv().goodFeaturesToTrack(eight, 0, WEAKEST_CORNER, step)
    places = np.zeros((0, 2)) if found is None else found.reshape(-1, 2)
    return np.unique(np.rint(places).astype(float), axis=0)


def _edges(eight, step):
    """The first edge point of every cell."""
    cv2 = need_opencv()
    smooth = cv2.GaussianBlur(eight, (0, 0), 1.0)
    slope = np.hypot(cv2.Sobel(smooth, cv2.CV_32F, 1, 0), cv2.Sobel(smooth, cv2.CV_32F, 0, 1))
    strong = float(np.percentile(slope, 85)) + 1.0
    v, u = np.nonzero(cv2.Canny(smooth, 0.4 * strong, strong))
    _, first = np.unique(np.stack([v // step, u // step], 1), axis=0, return_index=True)
    return np.stack([u[first], v[first]], 1).astype(float)


def _eight_bits(grey, limits):
    low, high = limits
    stretched = (grey.astype(np.float32) - low) * (255 / max(high - low, 1e-9))
    return np.clip(stretched, 0, 255).astype(np.uint8)
