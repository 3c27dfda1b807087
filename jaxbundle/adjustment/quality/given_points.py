"""Errors of given points: every image of a point shows it at the same wrong place.

Targets of a board are not where its drawing has them: it is bent, its print is stretched, corners
beside a marker are displaced. A point that is held takes no part in the adjustment, and the
residuals of all its images share its error:

    F = ∂v/∂X·L,    L·Lᵀ = K = (1 + Σ_k w(d/(D/2ᵏ)))/(1 + octaves)

d are the distances of the points, D is the extent of the object, w is Wendland's function. The bend
of a board is smooth and of no known scale, a displaced corner is an error of its own: independent
errors and those of every octave have the same variance.

Errors in the plane that fits the points best and errors across it are two components: a print is
stretched or displaced in its plane, paper bends and lifts across it. Of the board of four cameras,
estimated as free points, these errors were 0.09 and 0.19 mm; taken as one component, differences of
halves of its points over their covariance were d²/n = 1.76, as two 1.59.
"""

from typing import Any

import numpy as np
from jaxtyping import Float, Int

from jaxbundle.geometry.principal_axes import principal_axes
from jaxbundle.leastsquares.quality.error_components import IMAGE, ErrorComponent
from jaxbundle.leastsquares.quality.error_effects import residual_change
from jaxbundle.leastsquares.solution import Solution
from jaxbundle.types import AnyArray, Scalar

GIVEN_POINTS = ("given points in plane", "given points out of plane")


def given_points_components(
    solution: Solution,
    rows: Int[np.ndarray, " rays"],
    point: Int[np.ndarray, " rays"],
    sigma: Float[np.ndarray, "rays 2"],
    octaves: int,
    min_points: int,
) -> list[ErrorComponent]:
    """The errors of points that are held and seen in two images or more, in and across the plane
    that fits them best; none with fewer than `min_points` of them.

    **Arguments:** of every image point the `rows` of x (y is the next), the object point and σ;
    `octaves` of smooth errors.
    """
    import scipy.sparse as sp

    X = np.asarray(solution.values["point"])
    is_held = ~np.asarray(solution.problem.table("point").free, bool).any(axis=1)
    is_given = is_held & (np.bincount(point, minlength=len(X)) > 1)
    given_rows = np.flatnonzero(is_given)
    if X.shape[1] != 3 or len(given_rows) < min_points:
        return []
    distances = np.linalg.norm(X[given_rows][:, None] - X[given_rows], axis=2)
    K = correlation_of_points(distances, distances.max(), np.eye(len(given_rows)), octaves)
    L = np.linalg.cholesky(K)
    is_of_given = is_given[point]
    column = np.searchsorted(given_rows, point[is_of_given])
    rows = np.concatenate([rows[is_of_given], rows[is_of_given] + 1])
    number = sum(np.asarray(v).size for v in solution.residuals.values())
    # The normal of the plane is the last.
    _, axes = principal_axes(X[given_rows] - X[given_rows].mean(0))
    parts = []
    for axis in axes:
        change = residual_change(solution, "point", is_given[:, None] * axis)
        shape = (number, len(given_rows))
        J = sp.csr_matrix((change[rows], (rows, np.tile(column, 2))), shape=shape)
        parts.append(J @ sp.csr_matrix(L))
    return [
        _scaled(name, sp.hstack(some).tocsr(), rows, sigma[is_of_given].T.ravel())
        for name, some in zip(GIVEN_POINTS, (parts[:2], parts[2:]))
    ]


def _scaled(
    name: str, root: Any, rows: Int[np.ndarray, " n"], sigma: Float[np.ndarray, " n"]
) -> ErrorComponent:
    """A component whose √θ is the RMS of the effect on an image coordinate."""
    effect = np.asarray(root.power(2).sum(1)).ravel()[rows] * sigma**2
    return ErrorComponent(name, IMAGE, root / np.sqrt(effect.mean()))


def correlation_of_points(
    distances: Float[AnyArray, "n n"],
    extent: Scalar,
    identity: Float[AnyArray, "n n"],
    octaves: int,
) -> Float[AnyArray, "n n"]:
    """K from the distances of the points and the extent of the object; `identity`: the identity."""
    for k in range(octaves):
        identity = identity + wendland(distances / (extent / 2**k))
    return identity / (1 + octaves)


def wendland(distance: Float[AnyArray, "..."]) -> Float[AnyArray, "..."]:
    """Wendland's C² function of compact support, positive definite in space: 1 at 0, 0 from 1."""
    square = (1 - distance).clip(0) ** 2
    return square * square * (4 * distance + 1)
