"""Datum points of a reconstruction without control.

Inner constraints on all tie points would define the datum by the distant points with two rays, too:
their σ are a thousand times those of the others, and would be added to those of all coordinates.
So the datum is defined by points with at least three rays at a wide angle, spread over the
photographs.
"""

import dataclasses

import numpy as np
from jaxtyping import Float, Int

from jaxbundle.adjustment.far_points import angle_of_rays
from jaxbundle.adjustment.result import Adjustment


@dataclasses.dataclass(frozen=True)
class DatumPointSettings:
    """Settings of the choice of datum points. They change σ of coordinates and angles by the choice
    of their datum, and nothing that is independent of it."""

    min_rays: int = 3
    """Minimum rays of a datum point, since the error of one of two rays along the epipolar line is
    in no residual; two in a pair of photographs."""
    wide_angle: float = np.radians(5.0)
    """Angle between two rays that suffices for a datum point, radians: σ along them is then
    1/tan 2.5° = 23 times that across; if most angles are narrower, their median does."""
    cells: int = 4
    """Parts of a photograph, or of its area with points, in each direction; each has one datum
    point: 16 of each photograph surround it. More: points with larger σ define the datum, too."""
    min_points: int = 12
    """Minimum datum points; if there are fewer, all tie points define the datum. Three define one;
    four times as many do not depend on single points."""


def choose_datum_points(
    result: Adjustment, settings: DatumPointSettings = DatumPointSettings()
) -> tuple[str, ...]:
    """The ids of the datum points, in the order of the points; none if the datum is given
    otherwise, or all tie points are to define it."""
    problem = result.problem
    network = problem.network
    # Control or positions define the datum, or somebody chose it.
    if network.datum != "inner" or network.datum_points:
        return ()
    if network.points.has_role("control", "fixed").any():
        return ()
    is_used = problem.used
    image, point = problem.image[is_used], problem.point[is_used]
    rays = np.bincount(point, minlength=len(network.points))
    angle = angle_of_rays(problem, result.values)
    tie = network.points.has_role("tie")
    good = tie & (rays >= min(settings.min_rays, rays[tie].max(initial=0))) & (rays > 1)
    if not good.any():
        return ()
    good &= angle >= min(settings.wide_angle, float(np.median(angle[good])))
    rows = np.flatnonzero(good[point])
    image, point = image[rows], point[rows]
    cell = _cells(problem.image_coordinates()[is_used][rows], image, settings.cells)
    # The first of each cell: with the most rays, and the widest angle.
    order = np.lexsort((-angle[point], -rays[point], cell, image))
    first_in_cell = np.unique(np.stack([image[order], cell[order]]), axis=1, return_index=True)[1]
    chosen_points = np.unique(point[order][first_in_cell])
    if len(chosen_points) < settings.min_points:
        return ()
    return tuple(network.points.id[k] for k in chosen_points.tolist())


def _cells(
    xy: Float[np.ndarray, "rays 2"], image: Int[np.ndarray, " rays"], number: int
) -> Int[np.ndarray, " rays"]:
    """The part of its photograph, of `number` in each direction, in which each ray ends."""
    low, high = np.full((image.max() + 1, 2), np.inf), np.full((image.max() + 1, 2), -np.inf)
    np.minimum.at(low, image, xy)
    np.maximum.at(high, image, xy)
    share = (xy - low[image]) / np.maximum(high - low, 1e-12)[image]
    column, row = np.minimum((number * share).astype(int), number - 1).T
    return number * row + column
