"""Comparison of two clouds: distances along the normals of one, and heights above it.

At each point of the first cloud a plane through the nearest points of the second; the distance from
it, and its σ from those of both clouds if they have any.
"""

from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from jaxbundle.errors import InputError
from jaxbundle.surface.cloud import Cloud

NEIGHBOURS = 8
LARGEST_DISTANCE = 3.0
"""Maximum distance of neighbours, in median spacings of the second cloud."""
POINTS_AT_ONCE = 1 << 16


def compare(cloud: Cloud, other: Cloud) -> dict[str, Any]:
    """Numbers of points compared and beyond, distances: mean, median, RMS, robust σ (1.4826 times
    the median absolute deviation), 90 %; `normalised`: RMS of distances over their σ.

    **Raises:** `InputError` if either has fewer than four points."""
    if min(len(cloud), len(other)) < 4:
        raise InputError("a comparison needs clouds of at least four points")
    tree = cKDTree(other.X)
    k = min(NEIGHBOURS, len(other))
    spacing = float(np.median(tree.query(other.X[:: max(1, len(other) // 20_000)], 2)[0][:, 1]))
    distance, sigma = np.full(len(cloud), np.nan), np.full(len(cloud), np.nan)
    for first in range(0, len(cloud), POINTS_AT_ONCE):
        part = slice(first, min(first + POINTS_AT_ONCE, len(cloud)))
        found = _to_planes(cloud, other, tree, k, part, LARGEST_DISTANCE * spacing)
        distance[part], sigma[part] = found
    v = distance[np.isfinite(distance)]
    if not len(v):
        raise InputError("the clouds have nothing in common: check their coordinate systems")
    middle = float(np.median(v))
    ratio = (distance / sigma)[np.isfinite(distance) & np.isfinite(sigma) & (sigma > 0)]
    return {
        "points": len(v),
        "without_neighbours": int(len(cloud) - len(v)),
        "mean": float(v.mean()),
        "median": middle,
        "rms": float(np.sqrt(np.mean(v**2))),
        "robust_sigma": float(1.4826 * np.median(np.abs(v - middle))),
        "percentile_90": float(np.percentile(np.abs(v), 90)),
        "largest": float(np.abs(v).max()),
        "normalised_rms": float(np.sqrt(np.mean(ratio**2))) if len(ratio) else None,
    }


def _to_planes(cloud, other, tree, k, part, farthest):
    X = cloud.X[part]
    near, index = tree.query(X, k)
    neighbours = other.X[index]
    middle = neighbours.mean(1)
    d = neighbours - middle[:, None]
    _, vectors = np.linalg.eigh(np.einsum("nki,nkj->nij", d, d))
    normal = vectors[:, :, 0]
    # upwards, so that the sign of a distance has a meaning
    normal = normal * np.where(normal[:, 2:] < 0, -1.0, 1.0)
    distance = np.einsum("ni,ni->n", X - middle, normal)
    C = cloud.covariance[part] + np.nan_to_num(other.covariance[index]).mean(1)
    sigma = np.sqrt(np.einsum("ni,nij,nj->n", normal, C, normal))
    return np.where(near[:, min(3, k - 1)] <= farthest, distance, np.nan), sigma
