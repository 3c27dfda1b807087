"""The centre of a target, a light or dark spot, in a photograph.

1. The spot, its window and threshold: `spots`.
2. Centre by weighted grey values: with g the grey value, b that of the background, f that of the
   target, over the spot and its blurred edge,

       w = (g − b)/(f − b)        x̄ = Σw·x/Σw        σ² = σg²/(f − b)²·Σ(x − x̄)²/(Σw)²

3. Centre by an ellipse: grey-value profiles across the edge, along the normals of the spot's
   ellipse of inertia; the edge is at the mean of the local levels of target and background;
   then `fit_ellipse`. (Blur σ makes a disc of radius r smaller
   by about σ²/2r; its centre is unchanged.)

Both centres are those of the ellipse, not of the circle: `circle_centre_shift`.
"""

import dataclasses
from functools import partial

import numpy as np
import scipy  # its parts are loaded on use
from jaxtyping import Float

from jaxbundle.display import print_in_one_screen
from jaxbundle.errors import InputError
from jaxbundle.measure.ellipses import fit_ellipse
from jaxbundle.measure.spots import MARGIN, find_spot
from jaxbundle.system.programs import compile_once

PROFILES = (16, 32, 64)
"""Numbers of profiles: the largest not above the circumference in pixels, so that no pixel is
measured twice."""
STEP = 0.25
"""Step along a profile, in pixels."""
SAMPLING = 0.045
"""σ of an edge point due to the pixel raster, in pixels: with few profiles the fit hides it.

(Rendered discs of 2 to 10 pixels radius, blur 0.7 to 1.2: 0.03 to 0.045.)
"""


@print_in_one_screen
@dataclasses.dataclass(frozen=True)
class Target:
    """The measured centre of a target.

    **Fields:** `xy` and its `covariance`, pixels, with `sigma` their standard deviations; `bright`: lighter than its surroundings; `threshold`,
    `contrast`, `noise`: grey values; `axes`, `angle`: semi-axes (the longer first) in pixels and
    the direction of the longer one in radians, x right, y down.
    """

    xy: Float[np.ndarray, "2"]
    covariance: Float[np.ndarray, "2 2"]
    axes: Float[np.ndarray, "2"]
    angle: float
    bright: bool
    threshold: float
    contrast: float
    noise: float

    @property
    def sigma(self) -> Float[np.ndarray, "2"]:
        """Standard deviations of the coordinates, pixels."""
        return np.sqrt(np.diagonal(self.covariance))


def centre_by_grey_values(grey, near) -> Target:
    """The centre of the target nearest to `near` (column, row) as the centre of its grey values.

    **Arguments:** `grey` [rows, columns]; `near`: within a few pixels of the target.

    **Raises:** `InputError` if no target stands out, or it is cut by the edge of the image.
    """
    spot = find_spot(np.asarray(grey, float), np.asarray(near, float))
    xy, spread, total = _moments(spot)
    away = _places(spot) - xy[:, None, None]
    region = _region(spot)
    away = (away * region).reshape(2, -1)
    covariance = (spot.noise / (spot.contrast * total)) ** 2 * away @ away.T
    return _target(spot, xy, covariance, *_axes_of(spread))


def centre_by_ellipse(grey, near) -> Target:
    """The centre of the target nearest to `near` (column, row) by an ellipse through its
    edge; arguments and errors as in `centre_by_grey_values`."""
    spot = find_spot(np.asarray(grey, float), np.asarray(near, float))
    xy, spread, _ = _moments(spot)
    axes, angle = _axes_of(spread)
    edge = _edge_points(spot, xy, axes, angle)
    weights = np.isfinite(edge).all(1).astype(float)
    if weights.sum() < 0.6 * len(edge):
        raise InputError(f"{_place(spot, xy)}: the edge of the target is not fully visible")
    centre, covariance, axes, angle = _fit_robustly(np.nan_to_num(edge), weights)
    if not np.isfinite(covariance).all():
        raise InputError(f"{_place(spot, xy)}: the edge of the target is not an ellipse")
    return _target(spot, centre, covariance, axes, angle)


def _target(spot, xy, covariance, axes, angle):
    return Target(
        xy=xy + spot.corner, covariance=covariance, axes=np.asarray(axes), angle=float(angle),
        bright=spot.contrast > 0, threshold=spot.threshold, contrast=abs(spot.contrast),
        noise=spot.noise,
    )  # fmt: skip


def _place(spot, xy):
    x, y = xy + spot.corner
    return f"at ({x:.1f}, {y:.1f})"


def _region(spot):
    return scipy.ndimage.binary_dilation(spot.inside, np.ones((3, 3)), iterations=MARGIN)


def _places(spot):
    rows, columns = np.indices(spot.grey.shape)
    return np.stack([columns, rows]).astype(float)


def _moments(spot):
    """Centre, second central moments and sum of the relative grey values."""
    w = np.where(_region(spot), (spot.grey - spot.background) / spot.contrast, 0.0)
    places, total = _places(spot), w.sum()
    xy = (w * places).sum((1, 2)) / total
    away = np.where(spot.inside, places - xy[:, None, None], 0.0).reshape(2, -1)
    return xy, away @ away.T / spot.inside.sum(), total


def _axes_of(spread):
    """Semi-axes and angle of the ellipse with these second moments: an axis a has a²/4."""
    values, vectors = np.linalg.eigh(spread + np.eye(2) / 12)
    x, y = vectors[:, 1]
    return 2 * np.sqrt(values[::-1]), np.arctan2(y, x)


def _edge_points(spot, xy, axes, angle):
    """Points of the edge [profiles, 2], NaN for profiles without one."""
    circumference = np.pi * axes.sum()
    number = max([n for n in PROFILES if n <= circumference] or PROFILES[:1])
    t = 2 * np.pi * (np.arange(number) + 0.5) / number
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    start = xy + (axes * np.stack([np.cos(t), np.sin(t)], 1)) @ turn.T
    normal = np.stack([np.cos(t) / axes[0], np.sin(t) / axes[1]], 1) @ turn.T
    normal /= np.linalg.norm(normal, axis=1)[:, None]
    reach = min(MARGIN, 0.8 * axes[1])
    s = np.arange(-reach, MARGIN + STEP / 2, STEP)
    x, y = (start[:, None] + s[:, None] * normal[:, None]).transpose(2, 0, 1)
    profile = scipy.ndimage.map_coordinates(spot.grey, [y, x], order=3, mode="nearest")
    profile = (profile - spot.background) / spot.contrast
    inner, outer = profile[:, :3].mean(1), profile[:, -3:].mean(1)
    middle = (inner + outer) / 2
    crosses = (profile[:, :-1] > middle[:, None]) & (profile[:, 1:] <= middle[:, None])
    # of several crossings, the one nearest to the expected edge
    away = np.where(crosses, np.abs(s[:-1]), np.inf)
    k, all_of_them = away.argmin(1), np.arange(number)
    upper, lower = profile[all_of_them, k], profile[all_of_them, k + 1]
    with np.errstate(divide="ignore", invalid="ignore"):
        at = s[k] + STEP * (upper - middle) / (upper - lower)
    good = crosses.any(1) & (inner - outer > 0.3)
    return np.where(good[:, None], start + at[:, None] * normal, np.nan)


@partial(compile_once, static=())
def _fit(xy, weights):
    return fit_ellipse(xy, weights)


def _fit_robustly(xy, weights):
    """Centre, its covariance, axes and angle of the ellipse; the worst points are left out once."""
    for _ in range(2):
        found = _fit(xy, weights)
        away = _distances(found, xy)
        limit = 3.5 * max(1.4826 * np.median(np.abs(away[weights > 0])), 0.02)
        weights = weights * (np.abs(away) < limit)
    found = _fit(xy, weights)
    worse = max(SAMPLING / float(found.sigma0), 1.0)
    return tuple(
        np.asarray(x)
        for x in (found.centre, worse**2 * found.covariance, found.axes, found.angle)
    )


def _distances(ellipse, xy):
    """Distances of points [n, 2] from an ellipse, to first order."""
    c, s = np.cos(ellipse.angle), np.sin(ellipse.angle)
    along = (xy - np.asarray(ellipse.centre)) @ np.array([[c, -s], [s, c]])
    axes = np.asarray(ellipse.axes)
    radius = np.linalg.norm(along / axes, axis=1)
    slope = np.linalg.norm(along / axes**2, axis=1) / np.maximum(radius, 1e-9)
    return (radius - 1) / np.maximum(slope, 1e-9)
