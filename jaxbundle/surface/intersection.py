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

from jaxbundle.surface.views import OrientedImage, line_of_sight

STEPS = 3


@dataclasses.dataclass(frozen=True)
class Intersected:
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
    used: Bool[np.ndarray, "n views"],
    start: Float[np.ndarray, "n 3"],
) -> Intersected:
    """Intersect rays from approximate points; NaN if fewer than two are used or they are
    parallel."""
    n, m = used.shape
    X = start.copy()
    weight = np.zeros((n, m, 2, 2))
    weight[used] = np.linalg.inv(covariance[used])
    J, v, sights = np.zeros((n, m, 2, 3)), np.zeros((n, m, 2)), np.zeros((n, m, 3))
    Q = np.full((n, 3, 3), np.nan)
    for step in range(STEPS + 1):
        N, g = np.zeros((n, 3, 3)), np.zeros((n, 3))
        for k, view in enumerate(views):
            rows = np.flatnonzero(used[:, k])
            if step in (0, STEPS):  # they hardly change in between
                J[rows, k] = view.derivative(X[rows])
            v[rows, k] = view.project(X[rows]) - uv[rows, k]
            PJ = weight[rows, k] @ J[rows, k]
            N[rows] += np.swapaxes(J[rows, k], 1, 2) @ PJ
            g[rows] += np.einsum("nji,nj->ni", PJ, v[rows, k])
        Q = _inverse(N)
        if step < STEPS:
            change = np.einsum("nij,nj->ni", Q, g)
            X = X - change
    for k in range(m):
        rows = np.flatnonzero(used[:, k])
        sights[rows, k] = line_of_sight(J[rows, k])
    square = np.einsum("nki,nkij,nkj->nk", v, weight, v)
    rays = used.sum(1)
    return Intersected(
        X, Q, square.sum(1), 2 * rays - 3, rays, _widest(sights, used), np.sqrt(square)
    )


def _inverse(N):
    """Inverses scaled to a unit diagonal; NaN of singular ones."""
    with np.errstate(invalid="ignore", divide="ignore"):
        scale = 1 / np.sqrt(np.einsum("nii->ni", N))
        scaled = N * scale[:, :, None] * scale[:, None]
        good = np.isfinite(scaled).all((1, 2))
        safe = np.where(good[:, None, None], scaled, np.eye(3))
        good &= np.linalg.det(safe) > 1e-14
        safe = np.where(good[:, None, None], safe, np.eye(3))
        inverse = np.linalg.inv(safe) * scale[:, :, None] * scale[:, None]
    return np.where(good[:, None, None], inverse, np.nan)


def _widest(d, used):
    angle = np.zeros(len(d))
    for i in range(d.shape[1]):
        for j in range(i):
            both = used[:, i] & used[:, j]
            sine = np.linalg.norm(np.cross(d[both, i], d[both, j]), axis=1)
            cosine = np.abs(np.sum(d[both, i] * d[both, j], 1))
            angle[both] = np.maximum(angle[both], np.arctan2(sine, cosine))
    return angle
