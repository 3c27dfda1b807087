"""Errors of given points: every image of a point shows it at the same wrong place.

Targets of a board are not where its drawing has them: it is bent, its print is stretched, corners
beside a marker are displaced. A point that is held takes no part in the adjustment, and the
residuals of all its images share its error:

    F = ∂v/∂X·L,    L·Lᵀ = K = (1 + Σ_k w(d/(D/2ᵏ)))/(1 + octaves)

d are the distances of the points, D is the extent of the object, w is Wendland's function. The bend
of a board is smooth and of no known scale, a displaced corner is an error of its own: independent
errors and those of every octave have the same variance.
"""

import numpy as np
from jaxtyping import Float, Int

from jaxbundle.leastsquares.quality.error_components import IMAGE, ErrorComponent
from jaxbundle.leastsquares.quality.error_effects import residual_change
from jaxbundle.leastsquares.solution import Solution
from jaxbundle.types import AnyArray, Scalar

GIVEN_POINTS = "given points"


def given_points_component(
    found: Solution,
    rows: Int[np.ndarray, " rays"],
    point: Int[np.ndarray, " rays"],
    sigma: Float[np.ndarray, "rays 2"],
    octaves: int,
    min_points: int,
) -> ErrorComponent | None:
    """The errors of points that are held and seen in two images or more; None with fewer than
    `min_points` of them.

    **Arguments:** of every image point the `rows` of x (y is the next), the object point and σ;
    `octaves` of smooth errors.
    """
    import scipy.sparse as sp

    X = np.asarray(found.values["point"])
    held = ~np.asarray(found.problem.table("point").free, bool).any(axis=1)
    given = held & (np.bincount(point, minlength=len(X)) > 1)
    chosen = np.flatnonzero(given)
    if X.shape[1] != 3 or len(chosen) < min_points:
        return None
    apart = np.linalg.norm(X[chosen][:, None] - X[chosen], axis=2)
    K = correlation_of_points(apart, apart.max(), np.eye(len(chosen)), octaves)
    L = np.linalg.cholesky(K)
    own = given[point]
    column = np.searchsorted(chosen, point[own])
    rows = np.concatenate([rows[own], rows[own] + 1])
    number = sum(np.asarray(v).size for v in found.residuals.values())
    parts = []
    for axis in range(3):
        change = residual_change(found, "point", given[:, None] * np.eye(3)[axis])
        shape = (number, len(chosen))
        J = sp.csr_matrix((change[rows], (rows, np.tile(column, 2))), shape=shape)
        parts.append(J @ sp.csr_matrix(L))
    root = sp.hstack(parts).tocsr()
    # √θ is then the RMS of the effect on an image coordinate
    effect = np.asarray(root.power(2).sum(1)).ravel()[rows] * sigma[own].T.ravel() ** 2
    return ErrorComponent(GIVEN_POINTS, IMAGE, root / np.sqrt(effect.mean()))


def correlation_of_points(
    apart: Float[AnyArray, "n n"], extent: Scalar, own: Float[AnyArray, "n n"], octaves: int
) -> Float[AnyArray, "n n"]:
    """K from the distances of the points and the extent of the object; `own`: the identity."""
    for k in range(octaves):
        own = own + wendland(apart / (extent / 2**k))
    return own / (1 + octaves)


def wendland(distance: Float[AnyArray, "..."]) -> Float[AnyArray, "..."]:
    """Wendland's C² function of compact support, positive definite in space: 1 at 0, 0 from 1."""
    return (1 - distance).clip(0) ** 4 * (4 * distance + 1)
