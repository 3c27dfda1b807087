"""Reliability of the observations: redundancy numbers, tests for blunders, what they could hide.

With the residuals divided by their a priori σ (v/σ) and h = diag(J·Q·Jᵀ) (Baarda 1968; Förstner
1985):

    r   = 1 − h                     redundancy number, 0 (uncontrolled) to 1; Σr = redundancy
    w   = (v/σ)/√r                  Baarda's test, standard normal without a blunder (σ a priori)
    τ   = w/σ̂0                      Pope's test (1976), σ a posteriori
    MDB = σ·δ0/√r                   smallest blunder found with the chosen power
    δ̄   = δ0·√((1 − r)/r)           its largest effect on any unknown, in units of that σ
"""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxbundle.adjustment.jacobian import BundleJacobian, compiled_jacobian
from jaxbundle.adjustment.residuals import Residuals, compiled_residuals
from jaxbundle.network.arrays import Data, Values
from jaxbundle.network.structure import Structure
from jaxbundle.statistics.cofactors import Cofactors

UNCONTROLLED = 1e-8
"""Redundancy numbers below this are rounding: the observation is not controlled at all."""


class Reliability(eqx.Module):
    """Per observation, by kind: v/σ, redundancy number, Baarda's w. NaN where r is zero."""

    residual: Residuals
    redundancy: Residuals
    w: Residuals


def reliability(
    structure: Structure, values: Values, data: Data, cofactors: Cofactors
) -> Reliability:
    """Redundancy numbers and test statistics of all observations."""
    residual = compiled_residuals(structure, values, data)
    return _tested(compiled_jacobian(structure, values, data), residual, data, cofactors)


def held_against(
    structure: Structure, values: Values, data: Data, cofactors: Cofactors
) -> tuple[Residuals, Residuals]:
    """v/σ and h = diag(J·Q·Jᵀ) of all observations, with cofactors of another adjustment."""
    residual = compiled_residuals(structure, values, data)
    return residual, _hat(compiled_jacobian(structure, values, data), cofactors)


@eqx.filter_jit
def _hat(jac, cofactors) -> Residuals:
    return hat_diagonal(jac, cofactors)


@eqx.filter_jit
def _tested(jac, residual, data, cofactors) -> Reliability:
    hat = hat_diagonal(jac, cofactors)
    weight = _weights(data)
    number = lambda h, weight: jnp.where(weight > 0, jnp.clip(1.0 - h, 0.0, 1.0), 0.0)
    r = Residuals(*(number(h, w) for h, w in zip(_kinds(hat), weight)))
    test = lambda v, r: jnp.where(r > UNCONTROLLED, v / jnp.sqrt(jnp.maximum(r, 1e-300)), jnp.nan)
    w = Residuals(*(test(v, r) for v, r in zip(_kinds(residual), _kinds(r))))
    return Reliability(residual, r, w)


def _kinds(rows: Residuals):
    return rows.image, rows.control, rows.exterior, rows.interior, rows.distance


def _weights(data: Data):
    return (
        data.image_weight, data.control_weight, data.exterior_weight, data.interior_weight,
        data.distance_weight,
    )  # fmt: skip


def hat_diagonal(jac: BundleJacobian, cofactors: Cofactors) -> Residuals:
    """h = diag(J·Q·Jᵀ), from the blocks of Q that each observation touches."""
    s, Q = jac.structure, cofactors.internal
    w, k, K = s.image_width, s.camera_width, s.kept.shape[0]
    m = s.cameras * k
    points = cofactors.internal_point
    form = lambda a, block, b: jnp.einsum("nai,nij,naj->na", a, block, b)
    at_images = lambda a, block, b: jnp.sum(s.table.times_matrix(a, block) * b, 2)
    image = at_images(jac.image, Q.own, jac.image)
    image += form(jac.point, points[s.point], jac.point)
    image += 2 * form(jac.point, cofactors.ray, jac.image)
    interior = Q.own
    first = 6
    if k:
        at = jnp.arange(s.images)
        with_camera = Q.border[:m].reshape(s.cameras, k, s.images, w)[s.camera_of_image, :, at, :]
        own_camera = cofactors.camera[s.camera_of_image]
        image += at_images(jac.camera, own_camera, jac.camera)
        image += 2 * at_images(jac.camera, with_camera, jac.image)
        image += 2 * form(jac.point, cofactors.incidence[s.incidence.of_ray], jac.camera)
        interior, first = cofactors.camera, 0
    control = jac.control**2 * jnp.diagonal(points[s.control], axis1=1, axis2=2)
    exterior = jnp.einsum("eij,ejk,eik->ei", jac.exterior, Q.own[s.exterior, :6, :6], jac.exterior)
    variances = jnp.diagonal(interior, axis1=1, axis2=2)[s.interior, first:]
    rows = jnp.arange(s.interior.shape[0])[:, None]
    parameters = jnp.zeros((s.interior.shape[0], jac._parameters))
    if s.interior_width:
        parameters = parameters.at[rows, s.camera_columns[s.interior]].add(
            jac.interior**2 * variances
        )
    distance = jnp.zeros(s.distance.shape[0])
    if K:
        both = Q.corner[m:, m:].reshape(K, 3, K, 3)
        place = jnp.clip(jnp.searchsorted(s.kept, s.distance), 0, K - 1)
        a, b = place[:, 0], place[:, 1]
        ja, jb = jac.distance[:, 0], jac.distance[:, 1]
        quadratic = lambda x, i, j, y: jnp.einsum("di,dij,dj->d", x, both[i, :, j, :], y)
        distance = quadratic(ja, a, a, ja) + 2 * quadratic(ja, a, b, jb) + quadratic(jb, b, b, jb)
    return Residuals(image, control, exterior, parameters, distance)


def minimal_detectable(sigma, redundancy, delta0: float = 4.13) -> Float[np.ndarray, "..."]:
    """Smallest blunder found by the w-test, in the unit of σ (δ0 = 4.13: α 0.1 %, power 80 %)."""
    r = np.asarray(redundancy)
    return np.where(
        r > UNCONTROLLED, np.asarray(sigma) * delta0 / np.sqrt(np.maximum(r, UNCONTROLLED)), np.inf
    )


def external_reliability(redundancy, delta0: float = 4.13) -> Float[np.ndarray, "..."]:
    """Largest effect of an undetected blunder on any unknown, in units of that unknown's σ."""
    r = np.asarray(redundancy)
    bounded = np.maximum(r, UNCONTROLLED)
    return np.where(r > UNCONTROLLED, delta0 * np.sqrt((1 - bounded) / bounded), np.inf)
