"""Check points: intersected with the adjusted orientations, compared with their given coordinates.

They are excluded from the adjustment. Their σ includes that of the rays and the uncertainty of
orientations and cameras (`leastsquares/excluded_rows.py`).
"""

import dataclasses
from collections.abc import Mapping

import numpy as np
from jaxtyping import Float

from jaxbundle.adjustment.problem import shifted_problem
from jaxbundle.adjustment.quality.inspection import Inspection
from jaxbundle.adjustment.quality.variance_groups import groups
from jaxbundle.display import print_in_one_screen
from jaxbundle.leastsquares.excluded_rows import determine
from jaxbundle.leastsquares.quality.variance_components import rescale
from jaxbundle.network.tables import Distances, Observations, Points


@print_in_one_screen
@dataclasses.dataclass(frozen=True)
class CheckPoints:
    """Intersected check points: coordinates, cofactors (times σ0² for variances), differences from
    the given coordinates (NaN on axes with an infinite σ, which were not given)."""

    id: tuple[str, ...]
    position: Float[np.ndarray, "points 3"]
    difference: Float[np.ndarray, "points 3"]
    cofactor: Float[np.ndarray, "points 3 3"]
    rays: np.ndarray

    @property
    def rms(self) -> Float[np.ndarray, "3"]:
        """RMS of the differences in X, Y, Z, in the object unit; NaN if none is known."""
        known = np.isfinite(self.difference)
        with np.errstate(invalid="ignore"):
            return np.sqrt(np.where(known, self.difference**2, 0.0).sum(0) / known.sum(0))


def intersect_check_points(
    inspection: Inspection,
    points: Points,
    observations: Observations,
    factors: Mapping[str, float],
) -> CheckPoints:
    """Intersect the check points of a network with its adjusted orientations; `factors`: those of
    the groups of observations, as in the weights of the problem (variance components)."""
    # As tie points of a problem of their own, whose orientations are those of the adjustment with
    # their covariance: check points have no part in what they check.
    problem, role = inspection.problem, ("tie",) * len(points)
    network = problem.network.replace(
        points=dataclasses.replace(points, role=role, sigma=np.full((len(points), 3), np.nan)),
        observations=observations,
        distances=Distances.none(),
    )
    checks = shifted_problem(network, problem, inspection.adjusted)
    # With estimated variance components the rays of check points have the estimated σ as well.
    system = rescale(checks, groups(checks), factors)
    values, cofactor = determine(inspection.solution, system)
    position = np.asarray(values["point"]) + problem.origin
    return CheckPoints(
        points.id,
        position,
        np.where(np.isposinf(points.sigma), np.nan, position - points.position),
        cofactor,
        np.bincount(observations.point, minlength=len(points)),
    )
