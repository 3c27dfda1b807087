"""Comparison of two clouds: distances along the normals of one, and heights above it.

At each point of the first cloud a plane through the nearest points of the second; the distance from
it, and its σ from those of both clouds if they have any.
"""

from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.spatial import cKDTree

from jaxbundle.arguments import integer
from jaxbundle.errors import InputError
from jaxbundle.surfaces.cloud import Cloud
from jaxbundle.surfaces.scatter import robust_sigma


def compare(
    cloud: Cloud, other: Cloud, neighbours: int = 8, max_distance: float = 3.0
) -> dict[str, Any]:
    """Numbers of points compared and beyond, distances: mean, median, RMS, robust σ (1.4826 times
    the median absolute deviation), 90 %; `normalised`: RMS of distances over their σ.

    **Arguments:** `neighbours`: points of the second cloud that determine a plane, at least three;
    more of them average its noise over a larger part of the surface. `max_distance`: of the fourth
    neighbour, in median spacings of the second cloud; larger, and the plane is continued beyond the
    edge of the cloud and over its gaps.

    **Raises:** `InputError` if either has fewer than four points, or `neighbours` are fewer than
    three."""
    if min(len(cloud), len(other)) < 4:
        raise InputError("a comparison needs clouds of at least four points")
    tree = cKDTree(other.X)
    k = min(integer("neighbours", neighbours, least=3), len(other))
    # The median of 20 000 distances is within 1 % of that of all.
    spacing = float(np.median(tree.query(other.X[:: max(1, len(other) // 20_000)], 2)[0][:, 1]))
    distance, sigma = np.full(len(cloud), np.nan), np.full(len(cloud), np.nan)
    # The neighbours of 65 536 points and their matrices take under 100 MB.
    points_at_once = 1 << 16
    for begin in range(0, len(cloud), points_at_once):
        part = slice(begin, min(begin + points_at_once, len(cloud)))
        distances_and_sigma = _distances_to_planes(
            cloud, other, tree, k, part, max_distance * spacing
        )
        distance[part], sigma[part] = distances_and_sigma
    v = distance[np.isfinite(distance)]
    if not len(v):
        raise InputError("the clouds have nothing in common: check their coordinate systems")
    is_known = np.isfinite(distance) & np.isfinite(sigma) & (sigma > 0)
    ratio = distance[is_known] / sigma[is_known]
    return {
        "points": len(v),
        "without_neighbours": int(len(cloud) - len(v)),
        "mean": float(v.mean()),
        "median": float(np.median(v)),
        "rms": float(np.sqrt(np.mean(v**2))),
        "robust_sigma": robust_sigma(v),
        "percentile_90": float(np.percentile(np.abs(v), 90)),
        "largest": float(np.abs(v).max()),
        "normalised_rms": float(np.sqrt(np.mean(ratio**2))) if len(ratio) else None,
    }


def _distances_to_planes(
    cloud: Cloud, other: Cloud, tree: cKDTree, k: int, part: slice, farthest: float
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    X = cloud.X[part]
    distance_to_neighbours, index = tree.query(X, k)
    neighbours = other.X[index]
    middle = neighbours.mean(1)
    d = neighbours - middle[:, None]
    _, vectors = np.linalg.eigh(np.einsum("nki,nkj->nij", d, d))
    normal = vectors[:, :, 0]
    # Upwards, so that the sign of a distance has a meaning.
    normal = normal * np.where(normal[:, 2:] < 0, -1.0, 1.0)
    distance = np.einsum("ni,ni->n", X - middle, normal)
    # Neighbours share the errors of their base image: their mean is not more precise than one.
    C = cloud.covariance[part] + np.nan_to_num(other.covariance[index]).mean(1)
    sigma = np.sqrt(np.einsum("ni,nij,nj->n", normal, C, normal))
    return np.where(distance_to_neighbours[:, min(3, k - 1)] <= farthest, distance, np.nan), sigma
