"""Control predicted from everything else: what a check of every control point, and of every image
measurement of one, would give, without adjusting again.

Of observations g of an adjustment (the coordinates of a control point, or both coordinates of an
image point), in units of their σ, with their residuals v_g and hat matrix H_gg = A_g·N⁻¹·A_gᵀ, the
error of their prediction from all others, and its cofactors, are

    e_g = (1 − H_gg)⁻¹·v_g,        Q_e = (1 − H_gg)⁻¹

(deletion residuals; Cook and Weisberg 1982, section 2.2), predicted minus given. Q_e contains the
observation itself: σ of e is that with which a good one varies. Under an error model its covariance
is (1 − H_gg)⁻¹·(M·Σ·M)_gg·(1 − H_gg)⁻¹, M = 1 − A·N⁻¹·Aᵀ. A direction that the others leave open,
such as the distance of a point of one ray, is not predicted.
"""

import dataclasses
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from jaxbundle.adjustment.problem import NetworkProblem
from jaxbundle.adjustment.quality.correlated_errors import first_row_of_rays
from jaxbundle.adjustment.quality.inspection import Inspection
from jaxbundle.leastsquares.quality.distributions import chi2_tail, f_tail
from jaxbundle.leastsquares.quality.error_components import ErrorModel
from jaxbundle.leastsquares.quality.error_effects import first_rows
from jaxbundle.leastsquares.quality.reliability import MIN_REDUNDANCY

# An axis with a larger part of an open direction, of length 1, is not predicted: 1 % of an error as
# large as the network is seen in the axis.
OPEN_PART = 0.01


@dataclasses.dataclass(frozen=True)
class ControlPrediction:
    """Of control points, by `id`: `error` (predicted minus given, object unit), its `sigma`, a
    posteriori, and the `probability` of a larger one by chance; of the image points of control and
    fixed points, by (photograph, point) in `measurement`: the same in the image unit. NaN where the
    other observations predict nothing."""

    id: tuple[str, ...]
    error: Float[np.ndarray, "points 3"]
    sigma: Float[np.ndarray, "points 3"]
    probability: Float[np.ndarray, " points"]
    measurement: tuple[tuple[str, str], ...]
    image_error: Float[np.ndarray, "rays 2"]
    image_sigma: Float[np.ndarray, "rays 2"]
    image_probability: Float[np.ndarray, " rays"]

    def contradicted(self, level: float) -> tuple[str, ...]:
        """The control points whose prediction is less probable than this."""
        return tuple(id for id, p in zip(self.id, self.probability) if p < level)

    def wrong_measurements(self, level: float) -> tuple[tuple[str, str], ...]:
        """The image measurements whose prediction is less probable than this."""
        return tuple(m for m, p in zip(self.measurement, self.image_probability) if p < level)


def predict_control(
    inspection: Inspection,
    sigma0: float,
    model: ErrorModel | None = None,
    max_measurements: int = 5000,
    max_modelled: int = 500,
) -> ControlPrediction | None:
    """The predictions of all control points with σ, and of the measurements of control; None
    without control with σ.

    `model`: of the errors of all observations. `max_measurements`: more are not control of a block,
    but a board or a resection, whose residuals are shown anyway; under a model `max_modelled`,
    since each of them takes two solutions of the normal equations, ten seconds in a network of 60
    images and 26 000 points."""
    problem = inspection.problem
    if not any(o.name == "control" for o in problem.observations):
        return None
    ids, points = _predict_points(inspection, sigma0, model)
    max_rays = max_measurements if model is None else max_modelled
    rays = np.flatnonzero(problem.network.points.has_role("control", "fixed")[problem.point])
    rays = rays if len(rays) <= max_rays else rays[:0]
    return ControlPrediction(ids, *points, *predict_measurements(inspection, sigma0, rays, model))


# Errors [n, k], their σ [n, k], probabilities [n].
Prediction = tuple[np.ndarray, np.ndarray, np.ndarray]


def _predict_points(
    inspection: Inspection, sigma0: float, model: ErrorModel | None
) -> tuple[tuple[str, ...], Prediction]:
    problem, ids = inspection.problem, inspection.problem.network.points.id
    freedom = problem.counts.redundancy
    (rows,) = problem.observations_of("control").rows
    weight = problem.weights("control")
    # A is the unit matrix: H is the block of cofactors in units of σ
    H = weight[:, :, None] * inspection.point_cofactors[rows] * weight[:, None, :]
    v = inspection.residuals["control"]
    C: Any = [None] * len(rows)
    if model is not None:
        first_row = first_rows(inspection.solution)["control"]
        C = model.covariances_of_residuals(first_row + np.arange(3 * len(rows)).reshape(-1, 3))
    predictions = [_delete(v[k], H[k], weight[k], sigma0, freedom, C[k]) for k in range(len(rows))]
    return tuple(ids[row] for row in rows), _collect(predictions, 3)


def predict_measurements(
    inspection: Inspection,
    sigma0: float,
    rays: Int[np.ndarray, " n"],
    model: ErrorModel | None = None,
) -> tuple[tuple[tuple[str, str], ...], np.ndarray, np.ndarray, np.ndarray]:
    """(photograph, point) of image points, by row of the network, that take part; the error of
    their prediction from all other observations [n, 2], its σ [n, 2] and probability [n]; `model`:
    of the errors of all observations."""
    problem, freedom = inspection.problem, inspection.problem.counts.redundancy
    rays = rays[problem.used[rays]]
    tested, weight = inspection.reliability, problem.image_weights
    v, h, joint = (
        np.asarray(problem.image_points(x)) for x in (tested.residual, tested.hat, tested.joint)
    )
    predictions, C = [], None
    if model is not None:
        first_row = first_row_of_rays(inspection.solution, problem)[rays]
        C = model.covariances_of_residuals(first_row[:, None] + np.arange(2))
    for n, k in enumerate(rays.tolist()):
        H = np.diag(h[k]) + joint[k] * (1 - np.eye(2))
        predictions.append(
            _delete(v[k], H, weight[k], sigma0, freedom, None if C is None else C[n])
        )
    return (_names(problem, rays), *_collect(predictions, 2))


def _names(problem: NetworkProblem, rays: np.ndarray) -> tuple[tuple[str, str], ...]:
    images, points = problem.network.images.id, problem.network.points.id
    return tuple(
        (images[i], points[p])
        for i, p in zip(problem.image[rays].tolist(), problem.point[rays].tolist())
    )


def _delete(
    v: Float[np.ndarray, " k"],
    H: Float[np.ndarray, "k k"],
    weight: Float[np.ndarray, " k"],
    sigma0: float,
    freedom: int,
    modelled: Float[np.ndarray, "k k"] | None = None,
) -> tuple[Float[np.ndarray, " k"], Float[np.ndarray, " k"], float]:
    """Error and σ of the prediction of one group of observations, and the probability of a larger
    T = eᵀ·Q_e⁻¹·e/σ0²; `weight`: 1/σ, 0 of what is no observation; `modelled`: covariance of the
    residuals by an error model."""
    has_weight = np.flatnonzero(weight > 0)
    error, sigma = np.full((2, len(v)), np.nan)
    redundancies, directions = np.linalg.eigh(
        np.eye(len(has_weight)) - H[np.ix_(has_weight, has_weight)]
    )
    is_controlled = redundancies > MIN_REDUNDANCY
    if not is_controlled.any():
        return error, sigma, np.nan
    is_predicted = (np.abs(directions[:, ~is_controlled]) < OPEN_PART).all(1)
    E = directions[:, is_controlled]
    components = E.T @ v[has_weight] / redundancies[is_controlled]
    unit = 1 / weight[has_weight]
    error[has_weight[is_predicted]] = (unit * (E @ components))[is_predicted]
    if modelled is not None:
        C = (
            E.T
            @ modelled[np.ix_(has_weight, has_weight)]
            @ E
            / np.outer(redundancies[is_controlled], redundancies[is_controlled])
        )
        sigma[has_weight[is_predicted]] = (unit * np.sqrt(np.einsum("ik,kl,il->i", E, C, E)))[
            is_predicted
        ]
        if not is_predicted.any():
            return error, sigma, np.nan
        # The sizes of the components are those of all observations: this group hardly changes them.
        return (
            error,
            sigma,
            chi2_tail(float(components @ np.linalg.solve(C, components)), int(is_controlled.sum())),
        )
    cofactor = (E**2 / redundancies[is_controlled]).sum(1)
    sigma[has_weight[is_predicted]] = (sigma0 * unit * np.sqrt(cofactor))[is_predicted]
    T, k = (
        float((components**2 * redundancies[is_controlled]).sum()) / sigma0**2,
        int(is_controlled.sum()),
    )
    # σ0 contains the residuals of the group: it is the larger, the worse the group is
    remaining_freedom = freedom - k
    if remaining_freedom <= 0 or not is_predicted.any():
        return error, sigma, np.nan
    # T is at most `freedom`, but for rounding: where the group has all of vᵀPv, F stays finite.
    variance_of_others = max((freedom - T) / remaining_freedom, 1e-12)
    return error, sigma, f_tail(T / k / variance_of_others, k, remaining_freedom)


def _collect(predictions: list, width: int) -> Prediction:
    if not predictions:
        return np.zeros((0, width)), np.zeros((0, width)), np.zeros(0)
    error, sigma, probability = zip(*predictions)
    return np.array(error), np.array(sigma), np.array(probability)
