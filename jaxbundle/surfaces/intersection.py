"""Intersection of any number of rays, of images of any kind, with full covariance.

    Σ vₖᵀ·Cₖ⁻¹·vₖ = min,        vₖ = projectₖ(X) − (u, v)ₖ

over the base image and the others, each position with the covariance of its match. That of a
match is the sum of the noise of both windows: half of it is assigned to the position in the other
image, half to that in the base, common to all matches. So the correlation of matches in several
images is taken into account.
"""

import dataclasses
from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxbundle.surfaces.views import OrientedImage, line_of_sight


@dataclasses.dataclass(frozen=True)
class IntersectedPoints:
    """Points X [n, 3], their covariance before it is multiplied by a variance factor, vᵀC⁻¹v, its
    redundancy, number of rays, widest angle between two of them in radians; w [n, views]: the
    residual of each view in units of its σ."""

    X: Float[np.ndarray, "n 3"]
    covariance: Float[np.ndarray, "n 3 3"]
    vtpv: Float[np.ndarray, " n"]
    redundancy: Int[np.ndarray, " n"]
    rays: Int[np.ndarray, " n"]
    angle: Float[np.ndarray, " n"]
    misfit: Float[np.ndarray, "n views"]


def intersect(
    views: Sequence[OrientedImage],
    uv: Float[np.ndarray, "n views 2"],
    covariance: Float[np.ndarray, "n views 2 2"],
    is_used: Bool[np.ndarray, "n views"],
    start: Float[np.ndarray, "n 3"],
) -> IntersectedPoints:
    """Intersect rays from approximate points; NaN if fewer than two are used or they are
    parallel."""
    n, m = is_used.shape
    X = start.copy()
    weight = np.zeros((n, m, 2, 2))
    weight[is_used] = np.linalg.inv(covariance[is_used])
    J, PJ = np.zeros((n, m, 2, 3)), np.zeros((n, m, 2, 3))
    v, sights = np.zeros((n, m, 2)), np.zeros((n, m, 3))
    Q = np.full((n, 3, 3), np.nan)
    # Points start within a few pixels of their rays, where the projection is nearly linear: on
    # rendered photographs one Gauss-Newton step is as good as six; three are safe. A fourth pass
    # computes the residuals, Jacobians and Q at the result.
    steps = 3
    for step in range(steps + 1):
        N, g = np.zeros((n, 3, 3)), np.zeros((n, 3))
        renewed = step in (0, steps)  # J, and N with it, hardly change in between
        for k, view in enumerate(views):
            rows = np.flatnonzero(is_used[:, k])
            if renewed:
                J[rows, k] = view.derivative(X[rows])
                PJ[rows, k] = weight[rows, k] @ J[rows, k]
                N[rows] += np.swapaxes(J[rows, k], 1, 2) @ PJ[rows, k]
            v[rows, k] = view.project(X[rows]) - uv[rows, k]
            g[rows] += np.einsum("nji,nj->ni", PJ[rows, k], v[rows, k])
        if renewed:
            Q = _inverse(N)
        if step < steps:
            X = X - np.einsum("nij,nj->ni", Q, g)
    for k in range(m):
        rows = np.flatnonzero(is_used[:, k])
        sights[rows, k] = line_of_sight(J[rows, k])
    square = np.einsum("nki,nkij,nkj->nk", v, weight, v)
    rays = is_used.sum(1)
    return IntersectedPoints(
        X, Q, square.sum(1), 2 * rays - 3, rays, _widest_angles(sights, is_used), np.sqrt(square)
    )


def _inverse(N: Float[np.ndarray, "n 3 3"]) -> Float[np.ndarray, "n 3 3"]:
    """Inverses scaled to a unit diagonal; NaN of singular ones."""
    with np.errstate(invalid="ignore", divide="ignore"):
        scale = 1 / np.sqrt(np.einsum("nii->ni", N))
        scaled = N * scale[:, :, None] * scale[:, None]
        good = np.isfinite(scaled).all((1, 2))
        safe = np.where(good[:, None, None], scaled, np.eye(3))
        # The determinant falls with the square of the angle of nearly parallel rays. Below 50 times
        # the rounding of the sums, 2e-16, the inverse would be rounding.
        good &= np.linalg.det(safe) > 1e-14
        safe = np.where(good[:, None, None], safe, np.eye(3))
        inverse = np.linalg.inv(safe) * scale[:, :, None] * scale[:, None]
    return np.where(good[:, None, None], inverse, np.nan)


def _widest_angles(
    sights: Float[np.ndarray, "n views 3"], is_used: Bool[np.ndarray, "n views"]
) -> Float[np.ndarray, " n"]:
    """The widest angle between two of the lines of sight of each point, radians."""
    angle = np.zeros(len(sights))
    for i in range(sights.shape[1]):
        for j in range(i):
            in_both = is_used[:, i] & is_used[:, j]
            sine = np.linalg.norm(np.cross(sights[in_both, i], sights[in_both, j]), axis=1)
            cosine = np.abs(np.sum(sights[in_both, i] * sights[in_both, j], 1))
            angle[in_both] = np.maximum(angle[in_both], np.arctan2(sine, cosine))
    return angle
