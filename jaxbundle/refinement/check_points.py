"""Check points: what took no part, against the refined images.

At the given coordinates, a check point is projected: its residuals in lines and pixels, with

    σ_v² = σ0²·(1/p + A·Q·Aᵀ).

On the ground, the rays of two or more images give the point, δ = −(Σ BᵀB)⁻¹·Σ Bᵀv; one scanner
image gives it at its given height, δ east and north only.
"""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxbundle.refinement.equations import (
    System,
    Unknowns,
    compiled_image_residuals,
    compiled_rescaled,
    residuals,
)
from jaxbundle.refinement.inspection import Inspection
from jaxbundle.refinement.solver import jacobian

STEPS = 3


@dataclasses.dataclass(frozen=True)
class CheckPoints:
    """Differences computed − given along the axes of the points, metres, NaN where the height is
    the given one; their σ; the number of rays. `residual` of every ray, not divided by σ, with
    `residual_sigma`, in the order of the rays of the images.
    """

    id: tuple[str, ...]
    difference: Float[np.ndarray, "points 3"]
    sigma: Float[np.ndarray, "points 3"]
    rays: np.ndarray
    residual: Float[np.ndarray, "rays 2"]
    residual_sigma: Float[np.ndarray, "rays 2"]

    @property
    def rms(self) -> Float[np.ndarray, "3"]:
        """RMS of the differences along each axis, NaN without any."""
        known = np.isfinite(self.difference)
        square = np.where(known, self.difference, 0.0) ** 2
        number = known.sum(0)
        return np.where(number > 0, np.sqrt(square.sum(0) / np.maximum(number, 1)), np.nan)


def intersect(system: System, found: Inspection, ids: tuple[str, ...]) -> CheckPoints:
    """The check points of a system of their own, with the refined images of another."""
    shared = found.unknowns.shared
    start = eqx.tree_at(lambda u: u.shared, system.start(), shared)
    system = compiled_rescaled(system, start)
    number = np.bincount(np.concatenate([r.point for r in system.rays]), minlength=len(ids))
    free = np.where((number < 2)[:, None], [1.0, 1.0, 0.0], 1.0)
    system = eqx.tree_at(
        lambda s: (s.free, s.prior), system,
        (jnp.asarray(free), jnp.zeros_like(system.prior)),
    )  # fmt: skip
    v0 = np.concatenate([np.asarray(v) for v in compiled_image_residuals(system, start)])
    A, _, _, = _rows(system, start)[1:]
    change = np.zeros((len(ids), 3))
    for _ in range(STEPS):
        v, A_now, B, of = _rows(system, Unknowns(shared, jnp.asarray(change)))
        V, g = np.zeros((len(ids), 3, 3)), np.zeros((len(ids), 3))
        W = np.zeros((len(ids), 3, len(shared)))
        np.add.at(V, of, B[:, :, None] * B[:, None, :])
        np.add.at(g, of, B * v[:, None])
        np.add.at(W, of, B[:, :, None] * A_now[:, None, :])
        inverse = np.linalg.pinv(V, 1e-13, hermitian=True)
        change = change - np.einsum("pij,pj->pi", inverse, g)
    G = inverse @ W
    Q = inverse + G @ found.cofactor @ G.transpose(0, 2, 1)
    known = free > 0
    sigma = found.sigma0 * np.sqrt(np.diagonal(Q, axis1=1, axis2=2))
    weight = np.concatenate([np.asarray(r.weight) for r in system.rays])
    spread = np.einsum("rm,mn,rn->r", A, found.cofactor, A).reshape(-1, 2)
    return CheckPoints(
        ids, np.where(known, change, np.nan), np.where(known, sigma, np.nan), number, v0,
        found.sigma0 * np.sqrt(1 + spread) / weight,
    )  # fmt: skip


@eqx.filter_jit
def _linear(system, unknowns):
    v, times = jax.linearize(lambda y: residuals(system, y), unknowns)
    J = jacobian(times, system)
    return v, J.shared, J.point, J.of


def _rows(system, unknowns):
    """v, A, B and the points of the rows of image points."""
    rows = 2 * sum(len(r.point) for r in system.rays)
    return [np.asarray(x)[:rows] for x in _linear(system, unknowns)]
