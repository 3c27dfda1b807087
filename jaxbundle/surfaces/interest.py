"""Selection of points of a base image for matching: every n-th pixel, edges, corners.

Whole pixels, since the windows of least squares matching are centred on a pixel.
"""

import numpy as np
from jaxtyping import Float, Shaped, UInt8

from jaxbundle.choices import SURFACE_POINTS
from jaxbundle.errors import InputError
from jaxbundle.photographs.opencv import need_opencv
from jaxbundle.surfaces.views import Grey


def interest_points(grey: Grey, kind: str, step: int) -> Float[np.ndarray, "n 2"]:
    """Places (u, v), about `step` pixels apart: on a `grid`, on `edges` (Canny, thresholds by the
    median gradient), on `corners` (Shi and Tomasi, 1994).

    **Raises:** `InputError` for another kind.
    """
    if kind == "grid":
        rows, columns = grey.shape
        v, u = np.mgrid[0:rows:step, 0:columns:step].reshape(2, -1)
        return np.stack([u, v], 1).astype(float)
    if kind not in SURFACE_POINTS:
        raise InputError(f"points {kind!r}: expected one of {', '.join(SURFACE_POINTS)}")
    limits = sample_percentiles(grey, 1, 99)
    find = _find_corners if kind == "corners" else _find_edges
    rows, columns = grey.shape
    # Tiles, for memory. Their edges have no gap of `step` pixels: two points may be nearer there.
    side = 2048
    points_by_tile = []
    for v in range(0, rows, side):
        for u in range(0, columns, side):
            tile = grey[v : v + side, u : u + side].astype(np.float32)
            points_by_tile.append(find(to_eight_bits(tile, limits), step) + [u, v])
    return np.concatenate(points_by_tile)


def sample_percentiles(grey: Grey, low: float, high: float) -> Float[np.ndarray, "2"]:
    """Percentiles of about a million pixels, spread over the image."""
    step = max(1, grey.size // (1 << 20))
    return np.percentile(grey.ravel()[::step], [low, high])


def to_eight_bits(
    grey: Shaped[np.ndarray, "*shape"], limits: Float[np.ndarray, "2"]
) -> UInt8[np.ndarray, "*shape"]:
    """Grey values stretched between two limits."""
    low, high = limits
    return np.clip((grey - low) * (255 / max(high - low, 1e-9)), 0, 255).astype(np.uint8)


def _find_corners(eight: UInt8[np.ndarray, "rows columns"], step: int) -> Float[np.ndarray, "n 2"]:
    # Corners of a thousandth of the strongest: with the distance of `step` pixels the strongest of
    # each neighbourhood is taken, and matching rejects those without texture.
    corners = need_opencv().goodFeaturesToTrack(eight, 0, 1e-3, step)
    places = np.zeros((0, 2)) if corners is None else corners.reshape(-1, 2)
    return np.unique(np.rint(places).astype(float), axis=0)


def _find_edges(eight: UInt8[np.ndarray, "rows columns"], step: int) -> Float[np.ndarray, "n 2"]:
    """The first edge point of every cell."""
    cv2 = need_opencv()
    smooth = cv2.GaussianBlur(eight, (0, 0), 1.0)
    slope = np.hypot(cv2.Sobel(smooth, cv2.CV_32F, 1, 0), cv2.Sobel(smooth, cv2.CV_32F, 0, 1))
    # 15 % of all pixels may begin an edge, which continues down to 40 % of that gradient; one grey
    # value more, since most of an image without texture has the gradient 0.
    strong = float(np.percentile(slope, 85)) + 1.0
    v, u = np.nonzero(cv2.Canny(smooth, 0.4 * strong, strong))
    _, first_of_cell = np.unique(np.stack([v // step, u // step], 1), axis=0, return_index=True)
    return np.stack([u[first_of_cell], v[first_of_cell]], 1).astype(float)
