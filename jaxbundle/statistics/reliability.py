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
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxbundle.adjustment.jacobian import BundleJacobian, compiled_jacobian
from jaxbundle.adjustment.residuals import Residuals, compiled_residuals
from jaxbundle.network.arrays import Data, Values
from jaxbundle.network.structure import Structure
from jaxbundle.statistics.cofactors import Cofactors

UNCONTROLLED = 1e-8
"""Redundancy numbers below this are rounding: the observation is not controlled at all."""
RAYS_AT_ONCE = 1 << 16


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
    k, K = s.camera_width, s.kept.shape[0]
    points = cofactors.internal_point
    interior, first = (cofactors.camera, 0) if k else (Q.own, 6)
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
        m = s.cameras * k
        both = Q.corner[m:, m:].reshape(K, 3, K, 3)
        place = jnp.clip(jnp.searchsorted(s.kept, s.distance), 0, K - 1)
        a, b = place[:, 0], place[:, 1]
        ja, jb = jac.distance[:, 0], jac.distance[:, 1]
        quadratic = lambda x, i, j, y: jnp.einsum("di,dij,dj->d", x, both[i, :, j, :], y)
        distance = quadratic(ja, a, a, ja) + 2 * quadratic(ja, a, b, jb) + quadratic(jb, b, b, jb)
    return Residuals(_of_rays(jac, cofactors), control, exterior, parameters, distance)


def _of_rays(jac: BundleJacobian, cofactors: Cofactors) -> Float[Array, "rays 2"]:
    """h of image coordinates, some chunks of the table of rays at a time: what belongs to the rays
    of all of it (2 000 000, say) is large."""
    s, table = jac.structure, jac.structure.table
    orientation = _of_orientations(s, cofactors)
    form = lambda a, blocks, b: jnp.sum((a @ blocks) * b, 2)

    def of_chunk(chunk):
        some = lambda rows: table.in_chunks(rows)[chunk]
        J, P, with_point = some(jac.image), some(jac.point), some(cofactors.ray)
        if s.camera_width:
            shared = cofactors.incidence[some(s.incidence.of_ray)]
            with_point = jnp.concatenate([with_point, shared], 2)
            J = jnp.concatenate([J, some(jac.camera)], 2)
        own = form(P, cofactors.internal_point[some(s.point)], P)
        return form(J, orientation[table.chunk_image[chunk]], J) + 2 * form(P, with_point, J) + own

    chunks = jnp.arange(len(table.chunk_image))
    at_once = max(RAYS_AT_ONCE // max(table.chunk, 1), 1)
    if len(chunks) > at_once:
        return jax.lax.map(of_chunk, chunks, batch_size=at_once).reshape(-1, 2)
    return jax.vmap(of_chunk)(chunks).reshape(-1, 2)


def _of_orientations(s: Structure, cofactors: Cofactors) -> Float[Array, "images m m"]:
    """The block of Q of every image together with its shared camera."""
    Q, w, k = cofactors.internal, s.image_width, s.camera_width
    if not k:
        return Q.own
    border = Q.border[: s.cameras * k].reshape(s.cameras, k, s.images, w)
    border = border[s.camera_of_image, :, jnp.arange(s.images), :]
    return jnp.concatenate([
        jnp.concatenate([Q.own, border.transpose(0, 2, 1)], 2),
        jnp.concatenate([border, cofactors.camera[s.camera_of_image]], 2),
    ], 1)  # fmt: skip


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
