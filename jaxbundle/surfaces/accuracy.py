"""The accuracy report of a cloud: mean, largest and smallest σX, σY, σZ, and numbers by classes;
RMS at check points, or to a plane."""

from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.spatial import cKDTree

from jaxbundle.geometry.principal_axes import principal_axes
from jaxbundle.surfaces.cloud import Cloud

# Bounds of σ in the object unit: those of the source, so that reports can be compared.
CLASSES = (0.0, 0.1, 0.5, 1.0, 2.0, 4.0, np.inf)
AXES = ("X", "Y", "Z")


def accuracy_of(cloud: Cloud) -> dict[str, Any]:
    """Mean, largest and smallest σ of each axis, and numbers of points by class of all three."""
    sigma = cloud.sigma
    is_known = np.isfinite(sigma).all(1)
    sigma = sigma[is_known]
    figures: dict[str, Any] = {"points": int(is_known.sum())}
    for k, axis in enumerate(AXES):
        s = sigma[:, k]
        figures[f"s{axis}"] = (
            {}
            if not len(s)
            else {
                "mean": float(s.mean()),
                "median": float(np.median(s)),
                "largest": float(s.max()),
                "smallest": float(s.min()),
            }
        )
    largest = sigma.max(1) if len(sigma) else np.zeros(0)
    number, _ = np.histogram(largest, CLASSES)
    figures["classes"] = [
        {"from": a, "to": None if np.isinf(b) else b, "points": int(n)}
        for a, b, n in zip(CLASSES, CLASSES[1:], number)
    ]
    return figures


def at_check_points(
    cloud: Cloud, check: Float[np.ndarray, "m 3"], radius: float | None = None, min_points: int = 6
) -> dict[str, Any]:
    """RMS of heights at check points: Z of the plane through the points within `radius` in X and Y,
    by default four spacings of the cloud; check points with fewer than `min_points` are left out.

    Six is twice the unknowns of a plane. Four spacings hold about 50 points of a grid: their noise
    is averaged, and a usual surface is a plane within them."""
    tree = cKDTree(cloud.X[:, :2])
    if radius is None:
        some = cloud.X[:: max(1, len(cloud) // 10_000), :2]
        radius = 4.0 * float(np.median(tree.query(some, 2)[0][:, 1])) if len(cloud) > 1 else 0.0
    misclosure = []
    for place in np.asarray(check, float):
        neighbours = tree.query_ball_point(place[:2], radius)
        if len(neighbours) >= min_points:
            d = cloud.X[neighbours] - place
            A = np.column_stack([np.ones(len(neighbours)), d[:, :2]])
            misclosure.append(np.linalg.lstsq(A, d[:, 2], rcond=None)[0][0])
    v = np.array(misclosure)
    return {
        "points": len(v),
        "rms_Z": float(np.sqrt(np.mean(v**2))) if len(v) else None,
        "mean_Z": float(v.mean()) if len(v) else None,
        "largest_Z": float(np.abs(v).max()) if len(v) else None,
    }


def to_plane(X: Float[np.ndarray, "n 3"]) -> dict[str, Any]:
    """RMS of distances from the best-fitting plane, its normal, a point on it."""
    middle = X.mean(0)
    _, axes = principal_axes(X - middle)
    distance = (X - middle) @ axes[2]
    return {
        "rms": float(np.sqrt(np.sum(distance**2) / max(len(X) - 3, 1))),
        "largest": float(np.abs(distance).max()),
        "normal": axes[2].tolist(),
        "point": middle.tolist(),
    }
