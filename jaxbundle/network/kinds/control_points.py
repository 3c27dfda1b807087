"""Control points: coordinates X, Y, Z of points, with σ on the axes that are given."""

from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float

from jaxbundle.leastsquares.declarations import Kind, ObservationSet
from jaxbundle.network.kinds.base import computed_minus_given

if TYPE_CHECKING:
    from jaxbundle.network.tables import Network

CONTROL_POINTS = Kind(
    "control points", computed_minus_given, ("point",), ("X", "Y", "Z"), "length", snooped="single"
)


def declare_control_points(
    network: "Network", origin: Float[np.ndarray, "3"]
) -> list[ObservationSet]:
    """The set "control", one row a control point, if there are any."""
    points = network.points
    rows = np.flatnonzero(points.has_role("control"))
    if not len(rows):
        return []
    # An axis that is not controlled has an infinite σ: a row without weight keeps the table
    # regular.
    measured, sigma = points.position[rows] - origin, points.sigma[rows]
    return [CONTROL_POINTS((rows,), measured, sigma=infinite_where_none(sigma), name="control")]


def infinite_where_none(sigma: Float[np.ndarray, "*shape"]) -> Float[np.ndarray, "*shape"]:
    """σ of values that are not given, or held exactly, are infinite: they are no observations."""
    return np.where(np.isfinite(sigma) & (sigma > 0), sigma, np.inf)
