"""Planes, lines, circles, spheres and cylinders near given points, in closed form: start values."""

import numpy as np
from jaxtyping import Float

from jaxbundle.geometry.principal_axes import principal_axes

TYPES = ("plane", "line", "circle", "sphere", "cylinder")
# Unknowns of a figure over the conditions that a point gives: plane 3/1, line 4/2, circle 6/2,
# sphere 4/1, cylinder 5/1.
FEWEST = {"plane": 3, "line": 2, "circle": 3, "sphere": 4, "cylinder": 5}


def fit(type: str, X: Float[np.ndarray, "n 3"]):
    """Origin [3], rotation M [3, 3] from space into the frame of the figure (its z axis the normal
    or the axis), and radius (NaN of a plane or a line)."""
    middle = X.mean(0)
    _, Vt = principal_axes(X - middle)
    if type == "plane":
        return middle, _frame(Vt[2]), np.nan
    if type == "line":
        return middle, _frame(Vt[0]), np.nan
    if type == "sphere":
        centre, radius, _ = _fit_circle(X - middle)
        return middle + centre, np.eye(3), radius
    if type == "circle":
        return _fit_about_axis(Vt[2], X)[:3]
    # The axis of a cylinder has no closed form: the best of 400 directions, 7° apart, from which an
    # adjustment converges; and of the principal axes, which long and short cylinders have.
    directions = (*Vt, *_hemisphere(400))
    axis = min(directions, key=lambda n: _fit_about_axis(n, X)[3])
    return _fit_about_axis(axis, X)[:3]


def _fit_about_axis(
    axis: Float[np.ndarray, "3"], X: Float[np.ndarray, "n 3"]
) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3 3"], float, float]:
    """The circle of points projected along an axis: origin, M, radius, RMS of its distances."""
    middle, M = X.mean(0), _frame(axis)
    centre, radius, rms = _fit_circle(((X - middle) @ M.T)[:, :2])
    return middle + M[:2].T @ centre, M, radius, rms


def _fit_circle(x: Float[np.ndarray, "n d"]) -> tuple[Float[np.ndarray, " d"], float, float]:
    """Centre, radius of a circle or a sphere (Kåsa 1976), and the RMS of the distances from it."""
    # |x − m|² = r² is linear in m and r² − m²: 2x·m + (r² − m²) = x². Biased for short arcs, but
    # start values need no more.
    A = np.concatenate([2 * x, np.ones((len(x), 1))], 1)
    *centre, constant = np.linalg.lstsq(A, (x**2).sum(1), rcond=None)[0]
    centre = np.array(centre)
    radius = np.sqrt(max(constant + centre @ centre, 0.0))
    residual = np.linalg.norm(x - centre, axis=1) - radius
    return centre, radius, float(np.sqrt((residual**2).mean()))


def _frame(z: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3 3"]:
    """A rotation whose last row is this direction."""
    x = np.cross(z, np.eye(3)[np.abs(z).argmin()])
    x = x / np.linalg.norm(x)
    return np.stack([x, np.cross(z, x), z])


def _hemisphere(n: int):
    """Directions spread over half a sphere (a spiral of the golden angle)."""
    z = (np.arange(n) + 0.5) / n
    turn = np.arange(n) * np.pi * (3 - np.sqrt(5))
    r = np.sqrt(1 - z**2)
    return np.stack([r * np.cos(turn), r * np.sin(turn), z], 1)
