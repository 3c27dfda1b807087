"""Epipolar rectification of two photographs: both are rotated to the normal case.

The x axis of the rectified cameras is along the base b, z along the mean of both optical axes less
its component along b; the principal distance f keeps the resolution of the base image. Then
epipolar lines are rows, and

    d = x − x' = f·b/Z,        X = X0 + Z·Rᵀ·[x/f, y/f, 1].

Distortion is removed at the same time: every rectified pixel is looked up by its ray. Grey values
are interpolated by cubic splines, since a table of 1/32 pixel would be visible in the heights.

Source: Fusiello, Trucco and Verri (2000), A compact algorithm for rectification of stereo pairs.
"""

import dataclasses
from concurrent.futures import ThreadPoolExecutor

import numpy as np
from jaxtyping import Float
from scipy import ndimage

from jaxbundle.surfaces.views import FrameView
from jaxbundle.system.cores import available_cores

# Pixels looked up together by one core: the temporary arrays take about 50 MB.
PIXELS_AT_ONCE = 1 << 18


@dataclasses.dataclass(frozen=True)
class RectificationSettings:
    """Which pairs are rectified, and the range of their disparities."""

    relative_margin: float = 0.15
    """Margin at both ends of the disparities of known points, relative to their range: nodes of a
    guide miss the highest and lowest parts of a surface. The time grows with it. Half: the same
    pixels within 0.03 %, RMS 0.995; double: 0.3 % more, 1.02 (scene of
    `DisparitySearchSettings`)."""
    min_margin: float = 8.0
    """Minimum of this margin, pixels: for flat surfaces, whose points have no range. Half and
    double: as for the relative margin."""
    max_angle: float = 1.25
    """Maximum angle between the axis of the rectified camera and a ray of the base image, radians:
    there an angle takes ten times (1/cos²) the pixels that it takes on the axis."""
    max_size_ratio: float = 5.0
    """Maximum pixels of the rectified image, as a multiple of those of the base image: of
    convergent photographs most of it would be empty. Larger: more memory."""


@dataclasses.dataclass(frozen=True)
class RectifiedPair:
    """A rectified pair: grey values (NaN outside), `origin` (x, y) of the left image's first pixel
    in the rectified camera, `lowest`: disparity of equal columns; R, f and base length."""

    left: Float[np.ndarray, "rows columns"]
    right: Float[np.ndarray, "rows columns"]
    origin: Float[np.ndarray, "2"]
    lowest: int
    X0: Float[np.ndarray, "3"]
    R: Float[np.ndarray, "3 3"]
    f: float
    base: float

    def places(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 2"]:
        """Columns and rows of points in the left image."""
        x, y, z = self.R @ (points - self.X0).T
        with np.errstate(invalid="ignore", divide="ignore"):
            places = np.stack([self.f * x / z, self.f * y / z], 1) - self.origin
        return np.where(z[:, None] > 0, places, np.nan)

    def disparity(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
        """Columns in the left minus those in the right image."""
        return self.f * self.base / (self.R[2] @ (points - self.X0).T) - self.lowest

    def points(
        self, place: Float[np.ndarray, "n 2"], disparity: Float[np.ndarray, " n"]
    ) -> Float[np.ndarray, "n 3"]:
        """The object points of positions in the left image; NaN beyond infinity."""
        total = disparity + self.lowest
        with np.errstate(divide="ignore", invalid="ignore"):
            Z = np.where(total > 0, self.f * self.base / total, np.nan)
        xy = (place + self.origin) / self.f
        return self.X0 + (Z[:, None] * np.column_stack([xy, np.ones(len(xy))])) @ self.R


def rectify(
    base: FrameView,
    other: FrameView,
    X: Float[np.ndarray, "n 3"],
    settings: RectificationSettings = RectificationSettings(),
) -> tuple[RectifiedPair, int] | None:
    """The pair, and the range of its disparities, that of the points X with a margin; None if one
    camera is in front of the other, or they are at one position, if the rectified image would be
    too wide or too large (`settings`), or if no point is in front."""
    b = other.X0 - base.X0
    length = float(np.linalg.norm(b))
    if not length > 0:
        return None
    x = b / length
    axis = -(base.M[2] + other.M[2])
    axis = axis - (axis @ x) * x
    # |axis| is twice the sine of the angle between base and viewing direction: under 6° one camera
    # is in front of the other
    if np.linalg.norm(axis) < 0.2:
        return None
    z = axis / np.linalg.norm(axis)
    R = np.stack([x, np.cross(z, x), z])
    edge = base.edge()
    d = (base.points(edge, np.ones(len(edge))) - base.X0) @ R.T
    if not (d[:, 2] > np.cos(settings.max_angle)).all():
        return None
    f = _resolution(base)
    low, high = (f * d[:, :2] / d[:, 2:]).min(0), (f * d[:, :2] / d[:, 2:]).max(0)
    first_column_and_row = np.floor(low)
    columns, rows = (int(n) for n in np.ceil(high) - first_column_and_row + 1)
    if columns * rows > settings.max_size_ratio * base.size[0] * base.size[1]:
        return None
    depth = (X - base.X0) @ z
    depth = depth[depth > 0]
    if not len(depth):
        return None
    # Without the few wrong nodes of a guide.
    d_low, d_high = np.percentile(f * length / depth, [0.3, 99.7])
    margin = settings.relative_margin * (d_high - d_low) + settings.min_margin
    # A disparity of 0 is a point at infinity.
    lowest = int(np.floor(max(d_low - margin, 0.0)))
    span = int(np.ceil(d_high + margin)) - lowest
    # `span` columns more on the left: a pixel of the base image at column c ≥ span has its match at
    # a column from c − span to c of the right image
    origin = first_column_and_row - [span, 0]
    shape = (rows, columns + span)
    left = _look_up(base, R, f, origin, shape)
    right = _look_up(other, R, f, origin - [lowest, 0], shape)
    return RectifiedPair(left, right, origin, lowest, base.X0, R, f, length), span


def disparity_range(base: FrameView, other: FrameView, X: Float[np.ndarray, "n 3"]) -> float | None:
    """Approximate range of the disparities of points, pixels; None for cameras at one position, or
    without a point in front."""
    b = other.X0 - base.X0
    length = float(np.linalg.norm(b))
    if not length > 0:
        return None
    axis = -(base.M[2] + other.M[2])
    axis = axis - (axis @ b) * b / length**2
    depth = (X - base.X0) @ (axis / max(float(np.linalg.norm(axis)), 1e-9))
    depth = depth[depth > 0]
    if not len(depth):
        return None
    return float(np.ptp(_resolution(base) * length / depth))


def _resolution(view: FrameView) -> float:
    """Pixels per radian in the middle of an image."""
    middle = np.array([[(n - 1) / 2 for n in view.size]])
    J = view.derivative(view.points(middle, np.ones(1)))[0]
    # √det(J·Jᵀ): the area of the image by that of the object plane across the line of sight at the
    # distance 1; its root is a length by an angle
    return float(np.sqrt(np.sqrt(np.linalg.det(J @ J.T))))


def _look_up(
    view: FrameView,
    R: Float[np.ndarray, "3 3"],
    f: float,
    origin: Float[np.ndarray, "2"],
    shape: tuple[int, int],
) -> Float[np.ndarray, "rows columns"]:
    """Grey values at the rays of a rectified camera, NaN outside the image."""
    rows, columns = shape
    coefficients = ndimage.spline_filter(np.asarray(view.grey, np.float32), 3, np.float32)
    out = np.empty(shape, np.float32)
    x = (np.arange(columns) + origin[0]) / f
    rows_at_once = max(1, PIXELS_AT_ONCE // columns)

    def fill(begin: int) -> None:
        y = (np.arange(begin, min(begin + rows_at_once, rows)) + origin[1]) / f
        d = np.stack([*np.meshgrid(x, y), np.ones((len(y), columns))], -1).reshape(-1, 3)
        uv = view.project(view.X0 + d @ R)
        is_inside = (uv > -0.5).all(1) & (uv < np.array(view.size) - 0.5).all(1)
        grey = np.full(len(uv), np.nan, np.float32)
        grey[is_inside] = ndimage.map_coordinates(
            coefficients, uv[is_inside, ::-1].T, order=3, prefilter=False, mode="nearest"
        )
        out[begin : begin + rows_at_once] = grey.reshape(len(y), -1)

    with ThreadPoolExecutor(available_cores()) as pool:
        list(pool.map(fill, range(0, rows, rows_at_once)))
    return out
