"""Check points: intersected with the adjusted orientations, compared with their given coordinates.

They take no part in the adjustment. Their σ contains the rays and the uncertainty of the
orientations and cameras: with V and W of their own rays and Q of the adjustment,

    Q_XX = V⁻¹ + V⁻¹·Wᵀ·Q·W·V⁻¹.
"""

import dataclasses

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxbundle.adjustment.jacobian import compiled_jacobian
from jaxbundle.adjustment.problem import Problem
from jaxbundle.adjustment.residuals import compiled_residuals
from jaxbundle.network.arrays import Data, Values
from jaxbundle.network.structure import Structure, make_structure
from jaxbundle.network.tables import Distances, Observations, Points
from jaxbundle.statistics.cofactors import Cofactors

STEPS = 20


@dataclasses.dataclass(frozen=True)
class CheckPoints:
    """Intersected check points: coordinates, cofactors (times σ0² for variances), differences."""

    id: tuple[str, ...]
    position: Float[np.ndarray, "points 3"]
    difference: Float[np.ndarray, "points 3"]
    cofactor: Float[np.ndarray, "points 3 3"]
    rays: np.ndarray

    @property
    def rms(self) -> Float[np.ndarray, "3"]:
        """RMS of the differences in X, Y, Z, in the object unit."""
        return np.sqrt((self.difference**2).mean(0))


def intersect_check_points(
    problem: Problem,
    values: Values,
    cofactors: Cofactors,
    points: Points,
    observations: Observations,
) -> CheckPoints:
    """Intersect the check points of a network with its adjusted orientations."""
    role = ("tie",) * len(points)
    network = problem.network.replace(
        points=Points(points.id, role, points.position, np.full((len(points), 3), np.nan)),
        observations=observations,
        distances=Distances.none(),
    )
    structure, data, origin, _ = make_structure(network)
    shift = jnp.asarray(problem.origin - origin)
    values = Values(
        values.camera, values.position + shift, values.rotation, data.start.point
    )
    point, V, W = _intersect(structure, values, data)
    inverse = np.linalg.inv(V)
    n = W.shape[2]
    spread = np.einsum("pij,pjn->pin", inverse, W)
    cofactor = inverse + spread @ np.asarray(cofactors.reduced)[:n, :n] @ spread.transpose(0, 2, 1)
    position = np.asarray(point) + origin
    return CheckPoints(
        points.id,
        position,
        position - points.position,
        cofactor,
        np.bincount(observations.point, minlength=len(points)),
    )


def _intersect(s: Structure, values: Values, data: Data):
    """Coordinates, V [points, 3, 3] and W [points, 3, reduced] of points seen by known images."""
    for _ in range(STEPS):
        step, V, W = _newton(s, values, data)
        values = eqx.tree_at(lambda v: v.point, values, values.point + step)
    return values.point, np.asarray(V), np.asarray(W)


def _newton(s, values, data):
    jac = compiled_jacobian(s, values, data)
    residual = compiled_residuals(s, values, data).image
    return _blocks(jac, residual)


@eqx.filter_jit
def _blocks(jac, residual):
    s = jac.structure
    V = jnp.zeros((s.points, 3, 3)).at[s.point].add(
        jnp.einsum("nai,naj->nij", jac.point, jac.point)
    )
    g = jnp.zeros((s.points, 3)).at[s.point].add(jnp.einsum("nai,na->ni", jac.point, residual))
    width = s.image_width
    W = jnp.zeros((s.points, 3, s.images, width))
    W = W.at[s.point, :, s.image].add(jnp.einsum("nai,naj->nij", jac.point, jac.image))
    W = W.reshape(s.points, 3, -1)
    if s.camera_width:
        shared = jnp.zeros((s.points, 3, s.cameras, s.camera_width))
        shared = shared.at[s.point, :, s.camera].add(
            jnp.einsum("nai,naj->nij", jac.point, jac.camera)
        )
        W = jnp.concatenate([W, shared.reshape(s.points, 3, -1)], 2)
    return -jnp.linalg.solve(V, g[..., None])[..., 0], V, W
