"""Check points: intersected with the adjusted orientations, compared with their given coordinates.

They take no part in the adjustment. Their σ contains the rays and the uncertainty of the
orientations and cameras: with V and W of their own rays and Q of the adjustment,

    Q_XX = V⁻¹ + V⁻¹·Wᵀ·Q·W·V⁻¹.
"""

import dataclasses
from collections.abc import Mapping

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxbundle.adjustment.jacobian import compiled_jacobian
from jaxbundle.adjustment.residuals import compiled_residuals
from jaxbundle.network.arrays import Tangent, Values
from jaxbundle.network.structure import make_structure
from jaxbundle.network.tables import Distances, Observations, Points
from jaxbundle.statistics.components import rescale
from jaxbundle.statistics.inspection import Inspection

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
    inspection: Inspection,
    values: Values,
    points: Points,
    observations: Observations,
    factors: Mapping[str, float],
) -> CheckPoints:
    """Intersect the check points of a network with its adjusted orientations; `factors`: those of
    the groups of observations, as in the weights of the problem (variance components)."""
    problem = inspection.problem
    role = ("tie",) * len(points)
    network = problem.network.replace(
        points=Points(points.id, role, points.position, np.full((len(points), 3), np.nan)),
        observations=observations,
        distances=Distances.none(),
    )
    structure, data, origin, _ = make_structure(network)
    data = rescale(network.cameras, structure, data, factors)
    shift = jnp.asarray(problem.origin - origin)
    shifted = Values(
        values.camera, values.position + shift, values.rotation, data.start.point
    )
    for _ in range(STEPS):
        step, inverse, spread = _newton(structure, shifted, data)
        shifted = eqx.tree_at(lambda v: v.point, shifted, shifted.point + step)
    # The part of the adjusted orientations in their cofactors, one point after the other.
    still = np.zeros((3, problem.structure.points, 3))
    of_orientations = [inspection.propagate(Tangent(*rows, still)) for rows in zip(*spread)]
    cofactor = np.asarray(inverse) + np.asarray(of_orientations)
    position = np.asarray(shifted.point) + origin
    return CheckPoints(
        points.id,
        position,
        position - points.position,
        cofactor,
        np.bincount(observations.point, minlength=len(points)),
    )


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
    W = jnp.zeros((s.points, 3, s.images, s.image_width))
    W = W.at[s.point, :, s.image].add(jnp.einsum("nai,naj->nij", jac.point, jac.image))
    Wc = jnp.zeros((s.points, 3, s.cameras, s.camera_width))
    if s.camera_width:
        Wc = Wc.at[s.point, :, s.camera].add(jnp.einsum("nai,naj->nij", jac.point, jac.camera))
    inverse = jnp.linalg.inv(V)
    spread = tuple(jnp.einsum("pij,pj...->pi...", inverse, rows) for rows in (W, Wc))
    return -jnp.einsum("pij,pj->pi", inverse, g), inverse, spread
