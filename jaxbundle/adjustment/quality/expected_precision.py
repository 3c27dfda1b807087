"""The expected precision of a network before measurement.

Cofactors at the start values, with the a priori σ and σ0 = 1: the report of `adjust` for a network
whose residuals agree with its σ.
"""

import dataclasses
from collections.abc import Mapping

import numpy as np
from jaxtyping import Float

from jaxbundle.adjustment.problem import make_problem
from jaxbundle.adjustment.quality.correlated_errors import stated_errors
from jaxbundle.adjustment.quality.inspection import Inspection
from jaxbundle.adjustment.quality.precision import predict
from jaxbundle.display import print_in_one_screen
from jaxbundle.errors import InputError
from jaxbundle.leastsquares.indexing.reduction import FACTORS
from jaxbundle.leastsquares.problem import with_data, with_factor
from jaxbundle.leastsquares.quality.error_components import Errors, IndependentErrors
from jaxbundle.leastsquares.solution import Solution
from jaxbundle.network.check import check_network
from jaxbundle.network.tables import Network


@print_in_one_screen
@dataclasses.dataclass(frozen=True)
class ExpectedPrecision:
    """A priori σ: of points [P, 3] (object unit; 0 where held) and projection centres [I, 3]."""

    point_ids: tuple[str, ...]
    roles: tuple[str, ...]
    points: Float[np.ndarray, "points 3"]
    centres: Float[np.ndarray, "images 3"]
    redundancy: int

    def summary(self, role: str = "tie") -> dict[str, tuple[float, float, float]]:
        """Mean, smallest and largest σ of X, Y, Z of the points of a role."""
        sigma = self.points[np.array(self.roles, dtype=object) == role]
        return {
            axis: (float(s.mean()), float(s.min()), float(s.max()))
            for axis, s in zip("XYZ", sigma.T)
        }


def expected_precision(
    network: Network, errors: Mapping[str, float] | None = None
) -> ExpectedPrecision:
    """The a priori precision of a network with start values; `errors`: sizes of errors that image
    points share, by name (`stated_errors`).

    **Raises:** `InputError` for a network that cannot be adjusted.
    """
    problem = with_factor(make_problem(check_network(network)))
    if problem.reduction not in FACTORS:
        raise InputError("the planned network is too large for its covariance; plan a part of it")
    inspection = Inspection(problem, problem.data.start)
    if not inspection.determined:
        raise InputError("the planned network is not fully determined; plan more overlap")
    operator: Errors = IndependentErrors(inspection.solution, 1.0)
    if errors:
        # Of image coordinates as they are expected: components refer to places on the sensor.
        predicted = with_data(problem, predict(problem, problem.data))
        operator = stated_errors(Solution(predicted, predicted.data.start), predicted, errors)
    sigma = lambda C: np.sqrt(np.clip(np.diagonal(np.asarray(C), axis1=1, axis2=2), 0, None))
    points = problem.network.points
    return ExpectedPrecision(
        points.id,
        points.role,
        sigma(operator.covariance("point")),
        sigma(operator.covariance("image"))[:, :3],
        problem.counts.redundancy,
    )
