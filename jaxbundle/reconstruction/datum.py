"""Datum points of a reconstruction without control.

Inner constraints on all tie points would define the datum by the distant points with two rays, too:
their σ are a thousand times those of the others, and would be added to those of all coordinates.
So the datum is defined by points with at least three rays at a wide angle, spread over the
photographs.
"""

import numpy as np
from jaxtyping import Float, Int

from jaxbundle.bundle.far_points import angle_of_rays
from jaxbundle.bundle.result import Adjustment

FEWEST_RAYS = 3
"""Minimum rays of a datum point; two in a pair of photographs."""
WIDE = np.radians(5.0)
"""Angle between two rays that suffices for a datum point; if most angles are narrower, their
median does."""
CELLS = 4
"""Parts of a photograph, or of its area with points, in each direction; each has one datum
point."""
FEWEST = 12
"""Minimum datum points; if there are fewer, all tie points define the datum."""


def choose_datum_points(result: Adjustment) -> tuple[str, ...]:
    """The ids of the datum points, in the order of the points; none if the datum is given
    otherwise, or all tie points are to define it."""
    problem = result.problem
    network = problem.network
    if network.datum != "inner" or network.datum_points:
        return ()
    if network.points.has_role("control", "fixed").any():
        return ()
    used = (np.asarray(problem.data.image_weight) > 0).any(1)
    image, point = problem.image[used], problem.point[used]
    rays = np.bincount(point, minlength=len(network.points))
    angle = angle_of_rays(problem, result.values)
    tie = network.points.has_role("tie")
    good = tie & (rays >= min(FEWEST_RAYS, rays[tie].max(initial=0))) & (rays > 1)
    if not good.any():
        return ()
    good &= angle >= min(WIDE, float(np.median(angle[good])))
    rows = np.flatnonzero(good[point])
    image, point = image[rows], point[rows]
    cell = _cells(np.asarray(problem.data.image_xy)[used][rows], image)
    # the first of each cell: with the most rays, and the widest angle
    order = np.lexsort((-angle[point], -rays[point], cell, image))
    first = np.unique(np.stack([image[order], cell[order]]), axis=1, return_index=True)[1]
    chosen = np.unique(point[order][first])
    if len(chosen) < FEWEST:
        return ()
    return tuple(network.points.id[k] for k in chosen.tolist())


def _cells(
    xy: Float[np.ndarray, "rays 2"], image: Int[np.ndarray, " rays"]
) -> Int[np.ndarray, " rays"]:
    """The part of its photograph in which each ray ends."""
    low, high = np.full((image.max() + 1, 2), np.inf), np.full((image.max() + 1, 2), -np.inf)
    np.minimum.at(low, image, xy)
    np.maximum.at(high, image, xy)
    along = (xy - low[image]) / np.maximum(high - low, 1e-12)[image]
    column, row = np.minimum((CELLS * along).astype(int), CELLS - 1).T
    return CELLS * row + column
