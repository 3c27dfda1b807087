"""Clouds filtered and thinned: by cubes, by σ and rays, by the distances of neighbours.

The statistical filter: Rusu et al. (2008), Towards 3D point cloud based object maps.
"""

import dataclasses

import numpy as np
from scipy.spatial import cKDTree

from jaxbundle.arguments import integer, one_of, positive
from jaxbundle.choices import CUBE_POINTS
from jaxbundle.errors import InputError
from jaxbundle.surfaces.cloud import Cloud
from jaxbundle.surfaces.scatter import robust_sigma


def thin(cloud: Cloud, size: float, least: int = 1, place: str = "mean") -> Cloud:
    """One point for every cube of side `size` with at least `least` points: their `mean`
    weighted by 1/σ², the lowest `corner` of the cube, or the `best` of them, with the smallest σ.

    Errors of neighbours are highly correlated, since their windows overlap: the mean has the σ of
    a single point, the root of the harmonic mean of the variances. A corner has the σ of the best
    point. Cubes begin at multiples of their side.

    **Raises:** `InputError`."""
    size, least = positive("size of the cubes", size), integer("least number of points", least)
    one_of("place", place, CUBE_POINTS)
    if not len(cloud):
        return cloud
    cube = np.floor(cloud.X / size).astype(np.int64)
    cubes, group, count = np.unique(cube, axis=0, return_inverse=True, return_counts=True)
    group = group.ravel()
    trace = np.einsum("nii->n", cloud.covariance)
    trace = np.where(np.isfinite(trace) & (trace > 0), trace, np.nan)
    has_covariance = bool(np.isfinite(trace).any())
    filled = np.where(np.isfinite(trace), trace, np.nanmax(trace) if has_covariance else 1.0)
    order = np.lexsort((filled, group))
    best = order[np.searchsorted(group[order], np.arange(len(cubes)))]
    thinned = cloud.take(best)
    if place == "corner":
        thinned = dataclasses.replace(thinned, X=cubes * size)
    elif place == "mean":
        weight = 1 / filled
        total = np.bincount(group, weight)
        mean = lambda a: np.bincount(group, weight * a) / total
        X = np.stack([mean(a) for a in cloud.X.T], 1)
        # Not 1/total: the errors of neighbours are not independent (see above).
        harmonic = count / total
        C = thinned.covariance * (harmonic / filled[best])[:, None, None]
        if thinned.shared is not None:
            scaled = thinned.shared * harmonic / filled[best]
            thinned = dataclasses.replace(thinned, shared=scaled)
        thinned = dataclasses.replace(
            thinned, X=X, covariance=C if has_covariance else thinned.covariance
        )
    return thinned.take(count >= least)


def drop_isolated(cloud: Cloud, neighbours: int = 8, limit: float = 3.0) -> Cloud:
    """Without the points whose mean distance to their nearest `neighbours` is more than the median
    of all by `limit` robust standard deviations.

    Eight neighbours are those around a point of a grid: fewer keep pairs of wrong points, more of
    them drop points of narrow surfaces.

    **Raises:** `InputError`."""
    neighbours, limit = integer("neighbours", neighbours), positive("limit", limit)
    if len(cloud) <= neighbours:
        return cloud
    distance, _ = cKDTree(cloud.X).query(cloud.X, neighbours + 1)
    mean = distance[:, 1:].mean(1)
    middle = np.median(mean)
    # At least a tenth of the median distance: the distances of a regular grid have no spread.
    scatter = max(robust_sigma(mean), 0.1 * float(middle))
    return cloud.take(mean <= middle + limit * scatter)


def drop_weak(
    cloud: Cloud, most_sigma: float | None = None, least_rays: int | None = None
) -> Cloud:
    """Without points of a σ above `most_sigma` on any axis, or of fewer rays than `least_rays`.

    **Raises:** `InputError` if the cloud has no σ."""
    keep = np.ones(len(cloud), bool)
    if most_sigma is not None:
        limit = positive("greatest σ", most_sigma)
        if len(cloud) and not np.isfinite(cloud.sigma).any():
            raise InputError("the cloud has no σ: expected columns sX, sY, sZ")
        with np.errstate(invalid="ignore"):
            keep &= (cloud.sigma <= limit).all(1)
    if least_rays is not None:
        keep &= cloud.rays >= integer("least number of rays", least_rays)
    return cloud.take(keep)
