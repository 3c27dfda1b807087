"""A regular point cloud: cubes with enough points, each replaced by its corner."""

import numpy as np
from jaxtyping import Float, Int

from jaxbundle.errors import InputError


def filter_cloud(
    points: Float[np.ndarray, "n 3"], size: float, least: int = 1
) -> tuple[Float[np.ndarray, "cubes 3"], Int[np.ndarray, " cubes"]]:
    """The lowest corners of the cubes of side `size` with at least `least` points.

    Cubes begin at whole multiples of their side; points on a face belong to the higher one.

    **Returns:** corners in the unit of the points, in ascending order, and numbers of points.
    """
    points = np.asarray(points, float)
    if points.ndim != 2 or points.shape[1] != 3 or not np.isfinite(points).all():
        raise InputError("point cloud: expected finite coordinates [points, 3]")
    if not (np.isfinite(size) and size > 0) or least < 1:
        raise InputError(
            f"point cloud: cubes of {size:g} with at least {least} points are impossible"
        )
    cubes, counts = np.unique(np.floor(points / size), axis=0, return_counts=True)
    full = counts >= least
    return cubes[full] * size, counts[full]
