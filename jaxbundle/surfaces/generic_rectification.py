"""Rectification of any two oriented images by a surface of one parameter (a height).

The base image is rotated so that its epipolar lines are rows, (a, b). The other image is sampled
at the images of the points of base pixels at the parameter q₀: points on this surface match without
disparity. Points at another q are shifted along the epipolar line by the disparity δ; so the
match of (a, b) is, in the other image, at the image of the point of (a − δ, b) at q₀.

Epipolar lines of scanners are curved, but straight in small parts of the image.
"""

import dataclasses

import numpy as np
from jaxtyping import Float, Float32
from scipy import ndimage
from scipy.interpolate import RectBivariateSpline

from jaxbundle.surfaces.segments import windows
from jaxbundle.surfaces.views import OrientedImage, Places


@dataclasses.dataclass(frozen=True)
class StraightenedPair:
    """A piece of a pair: grey values (NaN outside), the base's pixel of (a, b) = (0, 0) and its
    axes [2, 2]; `lowest` disparity, of equal columns; q₀."""

    left: Float[np.ndarray, "rows columns"]
    right: Float[np.ndarray, "rows columns"]
    corner: Float[np.ndarray, "2"]
    axes: Float[np.ndarray, "2 2"]
    lowest: int
    q0: float

    def base_places(self, ab: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 2"]:
        """Pixels of the base at columns and rows."""
        return self.corner + ab @ self.axes

    def columns_rows(self, uv: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 2"]:
        """Columns and rows of pixels of the base."""
        return (uv - self.corner) @ self.axes.T


def straighten(
    base: OrientedImage,
    other: OrientedImage,
    window: tuple[int, int, int, int],
    X: Float[np.ndarray, "n 3"],
    relative_margin: float = 0.3,
    min_margin: float = 12.0,
) -> tuple[StraightenedPair, int] | None:
    """A piece of the base (u₀, v₀, u₁, v₁) with what matches it, for the range of points X in it;
    and the range of disparities.

    **Arguments:** margin of the disparities beyond those of the points, relative to their range,
    and its minimum in pixels: twice those of photographs, since satellite images show houses that
    are wholly between the nodes of a guide. Larger: more time, and more repetitions of a texture;
    smaller: high houses are lost.
    """
    u0, v0, u1, v1 = window
    corners = np.array([[u0, v0], [u1, v0], [u0, v1], [u1, v1]], float)
    q0 = float(np.median(base.parameter(X)))
    shape = windows(base, other, X)
    if not shape.usable.any():
        return None
    # One direction for the whole piece: that of most epipolar lines.
    e = np.median(shape.axis[shape.usable], axis=0)
    e = e / np.linalg.norm(e)
    axes = np.array([e, [-e[1], e[0]]])
    uv, q = base.project(X), base.parameter(X)
    # Where the piece's epipolar line sees at q0 what the other image has of X.
    places_at_q0 = other.project(base.points(uv, np.full(len(uv), q0)))
    places_of_points = other.project(X)
    distance_along = np.sum((places_of_points - places_at_q0) * shape.other_axis, 1) / np.sum(
        shape.other_axis**2, 1
    )
    # A − δ looks at q0 where X is: its image is there.
    shift = -distance_along[shape.usable & np.isfinite(distance_along) & np.isfinite(q)]
    if not len(shift):
        return None
    # Without the few wrong nodes of a guide.
    low, high = np.percentile(shift, [0.3, 99.7])
    margin = relative_margin * (high - low) + min_margin
    lowest = int(np.floor(low - margin))
    span = int(np.ceil(high + margin) - np.floor(low - margin))
    ab = corners @ axes.T
    first_column_and_row = np.floor(ab.min(0)) - [span, 0]
    columns, rows = (int(n) for n in np.ceil(ab.max(0)) - first_column_and_row + 1)
    corner = first_column_and_row @ axes
    pair = StraightenedPair(np.zeros((0, 0)), np.zeros((0, 0)), corner, axes, lowest, q0)
    r, c = np.indices((rows, columns)).reshape(2, -1)
    left = _sample(base, pair.base_places(np.stack([c, r], 1).astype(float)))
    return dataclasses.replace(
        pair,
        left=left.reshape(rows, columns),
        right=_sample_other(base, other, pair, (rows, columns)),
    ), span


def _sample_other(
    base: OrientedImage, other: OrientedImage, pair: StraightenedPair, shape: tuple[int, int]
) -> Float32[np.ndarray, "rows columns"]:
    """Column x of the right image is where the pixel x − lowest of the base looks at q0."""
    rows, columns = shape
    # Projected at 33 × 33 nodes, with cubic splines in between: in a piece of 1500 pixels the
    # positions of a scanner are so smooth that a node every 47 pixels is enough.
    nodes_per_side = 33
    r, c = (np.linspace(0, n - 1, nodes_per_side) for n in shape)
    uv = pair.base_places(np.stack(np.meshgrid(c - pair.lowest, r), -1).reshape(-1, 2))
    places = other.project(base.points(uv, np.full(len(uv), pair.q0)))
    places = places.reshape(nodes_per_side, nodes_per_side, 2)
    places = np.where(np.isfinite(places), places, -1e4)
    # By FITPACK, whose splines (not-a-knot) continue at the edges: those of scipy.ndimage have no
    # slope there, and are wrong by a tenth of the distance of two nodes.
    nodes = np.arange(nodes_per_side)
    y, x = (np.arange(n) * (nodes[-1] / max(n - 1, 1)) for n in shape)
    fine = [RectBivariateSpline(nodes, nodes, places[..., k])(y, x) for k in (0, 1)]
    return _sample(other, np.stack(fine, -1).reshape(-1, 2)).reshape(shape)


def _sample(view: OrientedImage, uv: Places) -> Float32[np.ndarray, " n"]:
    """Grey values by cubic splines, NaN outside the image."""
    is_inside = (uv > -0.5).all(1) & (uv < np.array(view.size) - 0.5).all(1)
    if not is_inside.any():
        return np.full(len(uv), np.nan, np.float32)
    # The spline's coefficients at a pixel depend on others by 0.27 per pixel of distance: 16 pixels
    # more on all sides, and the part has the grey values of the whole image.
    low = np.maximum(np.floor(uv[is_inside].min(0)).astype(int) - 16, 0)
    high = np.ceil(uv[is_inside].max(0)).astype(int) + 17
    piece = np.asarray(view.grey[low[1] : high[1], low[0] : high[0]], np.float32)
    place = np.where(np.expand_dims(is_inside, 1), uv - low, 0.0)
    grey = ndimage.map_coordinates(
        piece, [place[:, 1], place[:, 0]], output=np.float32, order=3, mode="nearest"
    )
    return np.where(is_inside, grey, np.nan)
