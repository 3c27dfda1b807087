"""Check points: intersected with the adjusted orientations, compared with their given coordinates.

They are excluded from the adjustment. Their σ includes that of the rays and the uncertainty of
orientations and cameras (`leastsquares/excluded_rows.py`),

    dX = V⁻¹·(Eᵀe − Wᵀ·dx),        V = EᵀE of their own rays, with the errors e

Under an error model the rays of a check point share errors with those of the network, which its
orientations have absorbed: the principal point of a photograph that is shifted moves the check
point no more than a tie point.
"""

import dataclasses
from collections.abc import Mapping

import numpy as np
from jaxtyping import Float

from jaxbundle.adjustment.problem import NetworkProblem, shifted_problem
from jaxbundle.adjustment.quality.correlated_errors import CorrelationSettings, joint_components
from jaxbundle.adjustment.quality.inspection import Inspection
from jaxbundle.adjustment.quality.variance_groups import groups
from jaxbundle.display import print_in_one_screen
from jaxbundle.leastsquares.excluded_rows import DeterminedRows, determine_excluded
from jaxbundle.leastsquares.quality.error_components import ErrorModel, Errors, IndependentErrors
from jaxbundle.leastsquares.quality.error_effects import effects, first_rows
from jaxbundle.leastsquares.quality.variance_components import rescale
from jaxbundle.leastsquares.solution import Solution
from jaxbundle.network.tables import Distances, Observations, Points


@print_in_one_screen
@dataclasses.dataclass(frozen=True)
class CheckPoints:
    """Intersected check points: coordinates, their covariance, differences from the given
    coordinates (NaN on axes with an infinite σ, which were not given)."""

    id: tuple[str, ...]
    position: Float[np.ndarray, "points 3"]
    difference: Float[np.ndarray, "points 3"]
    covariance: Float[np.ndarray, "points 3 3"]
    rays: np.ndarray

    @property
    def rms(self) -> Float[np.ndarray, "3"]:
        """RMS of the differences in X, Y, Z, in the object unit; NaN if none is known."""
        is_known = np.isfinite(self.difference)
        with np.errstate(invalid="ignore"):
            return np.sqrt(np.where(is_known, self.difference**2, 0.0).sum(0) / is_known.sum(0))


def intersect_check_points(
    inspection: Inspection,
    points: Points,
    observations: Observations,
    factors: Mapping[str, float],
    errors: Errors,
    settings: CorrelationSettings,
) -> CheckPoints:
    """Intersect the check points of a network with its adjusted orientations.

    **Arguments:** `factors`: those of the groups of observations, as in the weights of the problem
    (variance components); `errors` of the observations, of an error model with its `settings`."""
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
    data = rescale(checks, groups(checks), factors).data
    system = dataclasses.replace(checks, data=data)
    determined = determine_excluded(inspection.solution, system)
    position = np.asarray(determined.values["point"]) + problem.origin
    if isinstance(errors, IndependentErrors):
        covariance = errors.variance * determined.cofactors(inspection.solution)
    else:
        covariance = _modelled_covariance(inspection, system, determined, errors, settings)
    return CheckPoints(
        points.id,
        position,
        np.where(np.isposinf(points.sigma), np.nan, position - points.position),
        covariance,
        np.bincount(observations.point, minlength=len(points)),
    )


def _modelled_covariance(
    inspection: Inspection,
    checks: NetworkProblem,
    determined: DeterminedRows,
    model: ErrorModel,
    settings: CorrelationSettings,
) -> Float[np.ndarray, "points 3 3"]:
    """The covariance of check points by the errors of the network and of their own rays."""
    own_solution = Solution(checks, determined.values)
    components = joint_components(
        (inspection.solution, inspection.problem), (own_solution, checks), settings
    )
    joint = dataclasses.replace(model, components=tuple(components))
    starts = first_rows(own_solution)
    size = sum(np.asarray(v).size for v in own_solution.residuals.values())
    number = len(determined.inverse)
    D = np.zeros((number, 3, size))
    for name, E in own_solution.jacobian_eliminated.items():
        point = checks.point[checks.image_rows[name]]
        for axis in range(E.shape[1]):
            rows = starts[name] + E.shape[1] * np.arange(len(E)) + axis
            D[point, :, rows] = np.einsum("nij,nj->ni", determined.inverse[point], E[:, axis])
    covariance = np.zeros((number, 3, 3))
    for k in range(number):
        of_network = effects(inspection.solution, determined.functions[k])
        covariance[k] = joint.of_effects(np.concatenate([-of_network, D[k]], 1))
    return covariance
