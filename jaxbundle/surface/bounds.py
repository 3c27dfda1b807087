"""Bounds of the depth of the surface: by given heights, by tie points, or by the geometry alone."""

import dataclasses
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from jaxbundle.surface.views import OrientedImage, is_inside, line_of_sight

FEWEST_POINTS = 5
"""Minimum tie points of an image for its depths."""
DEPTH_MARGIN = 0.35
"""Margin of the depths beyond those of the tie points, relative to their range."""
NEAREST_ANGLE, FARTHEST_ANGLE = 1.2, 0.003
"""Default angles of intersection of two images, radians."""


@dataclasses.dataclass(frozen=True)
class Bounds:
    """Bounds of q of the surface in an image; heights `low` to `high`, if given."""

    view: OrientedImage
    q: tuple[float, float]
    low: float | None = None
    high: float | None = None

    def __call__(self, uv: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 2"]:
        """[n, 2], ascending."""
        whole = np.broadcast_to(np.array(self.q, float), (len(uv), 2))
        if self.low is None or self.high is None:
            return whole.copy()
        q = self.view.bounds(uv, self.low, self.high)
        inside = np.stack([np.fmax(q[:, 0], whole[:, 0]), np.fmin(q[:, 1], whole[:, 1])], 1)
        # a line of sight that never reaches these heights keeps a range without matches
        return np.where((inside[:, :1] < inside[:, 1:]), inside, whole)


def bounds_from_points(
    view: OrientedImage, X: Float[np.ndarray, "n 3"]
) -> tuple[float, float] | None:
    """Bounds of q of the points in an image with a margin; None if they are too few."""
    X = X[is_inside(view, view.project(X))]
    if len(X) < FEWEST_POINTS:
        return None
    low, high = np.percentile(view.parameter(X), [1, 99])
    room = DEPTH_MARGIN * (high - low) + 0.05 * abs(high)
    return max(low - room, 0.2 * low if low > 0 else -np.inf), high + room


def bounds_from_geometry(view, others: Sequence) -> tuple[float, float] | None:
    """Bounds of q of photographs for usual angles of intersection, around the point where most
    of their optical axes are nearest to each other; None for images at one position."""
    bases = [np.linalg.norm(o.X0 - view.X0) for o in others]
    base = float(np.median(bases)) if bases else 0.0
    if not base > 0:
        return None
    near, far = base / np.tan(NEAREST_ANGLE), base / np.tan(FARTHEST_ANGLE)
    meetings = [s for o in others if (s := _axes_meet(view, o)) is not None]
    if meetings:
        s = float(np.median(meetings))
        near, far = max(near, s / 4), min(far, s * 4)
        if near >= far:
            near, far = s / 4, s * 4
    return 1 / far, 1 / near


def angle_at(views: Sequence[OrientedImage], X: Float[np.ndarray, "n 3"]) -> np.ndarray:
    """Angles between the lines of sight of two images at points, radians."""
    d, f = (line_of_sight(view.derivative(X)) for view in views)
    sine = np.linalg.norm(np.cross(d, f), axis=1)
    return np.arctan2(sine, np.abs(np.sum(d * f, 1)))


def _axes_meet(view, other) -> float | None:
    """Distance along the optical axis to the point nearest to another axis; None if behind or
    parallel."""
    a, b, t = -view.M[2], -other.M[2], other.X0 - view.X0
    sine2 = 1 - (a @ b) ** 2
    if sine2 < np.sin(np.radians(3)) ** 2:
        return None
    s = (t @ a - (a @ b) * (t @ b)) / sine2
    r = ((a @ b) * (t @ a) - t @ b) / sine2
    return float(s) if s > 0 and r > 0 else None
