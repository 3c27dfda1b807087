"""Bounds of the depth of the surface: by given heights, by tie points, or by the geometry alone."""

import dataclasses
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from jaxbundle.surfaces.views import FrameView, OrientedImage, is_inside, line_of_sight


@dataclasses.dataclass(frozen=True)
class Bounds:
    """Bounds of q of the surface in an image; heights `low` to `high`, if given."""

    view: OrientedImage
    q: tuple[float, float]
    low: float | None = None
    high: float | None = None

    def __call__(self, uv: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 2"]:
        """[n, 2], ascending."""
        whole_range = np.broadcast_to(np.array(self.q, float), (len(uv), 2))
        if self.low is None or self.high is None:
            return whole_range.copy()
        q = self.view.bounds(uv, self.low, self.high)
        clipped = np.stack(
            [np.fmax(q[:, 0], whole_range[:, 0]), np.fmin(q[:, 1], whole_range[:, 1])], 1
        )
        # A line of sight that never reaches these heights keeps a range without matches.
        return np.where((clipped[:, :1] < clipped[:, 1:]), clipped, whole_range)


def bounds_from_points(
    view: OrientedImage, X: Float[np.ndarray, "n 3"]
) -> tuple[float, float] | None:
    """Bounds of q of the points in an image with a margin; None for fewer than five points."""
    X = X[is_inside(view, view.project(X))]
    if len(X) < 5:
        return None
    # Without the extremes, which may be wrong points. The margin is wide, a third of the range and
    # more, since a few tie points miss the highest and lowest parts of a surface; of a flat one,
    # which has no range, it is 5 % of the distance. q stays positive: up to five times the greatest
    # distance is searched. Larger: more time and more false matches; smaller: parts of the surface
    # are lost.
    low, high = np.percentile(view.parameter(X), [1, 99])
    margin = 0.35 * (high - low) + 0.05 * abs(high)
    return max(low - margin, 0.2 * low if low > 0 else -np.inf), high + margin


def bounds_from_geometry(
    view: FrameView, others: Sequence[FrameView]
) -> tuple[float, float] | None:
    """Bounds of q of photographs for usual angles of intersection, around the point where most
    of their optical axes are nearest to each other; None for images at one position."""
    bases = [np.linalg.norm(o.X0 - view.X0) for o in others]
    base = float(np.median(bases)) if bases else 0.0
    if not base > 0:
        return None
    # Angles of intersection of 1.2 and 0.003 radians: nearer surfaces are not alike in both images,
    # and of farther ones the parallax is a few pixels. A wide range costs only time.
    nearest, farthest = base / np.tan(1.2), base / np.tan(0.003)
    meetings = [s for o in others if (s := _distance_to_axis(view, o)) is not None]
    if meetings:
        # Cameras that look at one thing: a quarter to four times its distance.
        s = float(np.median(meetings))
        nearest, farthest = max(nearest, s / 4), min(farthest, s * 4)
        if nearest >= farthest:
            nearest, farthest = s / 4, s * 4
    return 1 / farthest, 1 / nearest


def angle_at(
    views: Sequence[OrientedImage], X: Float[np.ndarray, "n 3"]
) -> Float[np.ndarray, " n"]:
    """Angles between the lines of sight of two images at points, radians."""
    d, f = (line_of_sight(view.derivative(X)) for view in views)
    sine = np.linalg.norm(np.cross(d, f), axis=1)
    return np.arctan2(sine, np.abs(np.sum(d * f, 1)))


def _distance_to_axis(view: FrameView, other: FrameView) -> float | None:
    """Distance along the optical axis to the point nearest to another axis; None if behind or
    parallel."""
    a, b, t = -view.M[2], -other.M[2], other.X0 - view.X0
    sine2 = 1 - (a @ b) ** 2
    # Axes within 3° are parallel: where they meet depends on errors of the orientation.
    if sine2 < np.sin(np.radians(3)) ** 2:
        return None
    s = (t @ a - (a @ b) * (t @ b)) / sine2
    r = ((a @ b) * (t @ a) - t @ b) / sine2
    return float(s) if s > 0 and r > 0 else None
