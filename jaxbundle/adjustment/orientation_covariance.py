"""The joint covariance of all orientations and cameras of a result."""

import numpy as np

from jaxbundle.adjustment.result import Adjustment
from jaxbundle.io.networks.orientation_covariance import OrientationCovariance, Unknown
from jaxbundle.network.tables import EXTERIOR


def orientation_covariance(
    result: Adjustment, largest_product: int = 20_000_000
) -> OrientationCovariance | None:
    """Joint covariance of X0 … kappa (radians) of all images and the free camera parameters,
    including tied ones; None if nothing was free, or if it is too large.

    `largest_product`: of these unknowns and the coordinates of points. Every unknown is propagated
    through all points, so memory grows with the product: 160 MB at the default, a block of 100
    images and 10 000 points.
    """
    problem, network = result.problem, result.network
    free = np.asarray(problem.table("image").free, bool)
    unknowns: list[Unknown] = [("image", id, n) for id in network.images.id for n in EXTERIOR]
    places = [("image", k, j) for k in range(len(network.images)) for j in range(6)]
    repeated = list(range(len(places)))
    for table in problem.cameras:
        for row, c in enumerate(table.cameras):
            names, columns = problem.free_parameters(c)
            for j in columns:
                equal_groups = [g[1:] for g in network.cameras[c].tie if g[0] == names[j]]
                for name in (names[j], *(tied for group in equal_groups for tied in group)):
                    unknowns.append(("camera", network.cameras[c].id, name))
                    repeated.append(len(places))
                places.append((table.name, row, j))
    if len(places) == free.size and not free.any():
        return None
    if len(places) * 3 * len(network.points) > largest_product:
        return None
    rows = {t.name: np.zeros((len(places), t.rows, t.space.width)) for t in problem.tables}
    for n, (name, row, column) in enumerate(places):
        rows[name][n, row, column] = 1.0
    # One row of the identity per unknown: the full inverse is never formed, only these columns.
    C = result.errors.propagate_rows(rows)
    is_free = np.concatenate([free.ravel(), np.ones(len(places) - free.size)])
    from scipy.linalg import block_diag  # imported here: slow, and rarely needed

    # From small rotations δθ to ω, φ, κ; then the rows of tied parameters are repeated.
    turns = (block_diag(np.eye(3), A) for A in result.angle_jacobian)
    A = block_diag(*turns, np.eye(len(places) - free.size)) * is_free
    C = (A @ C @ A.T)[np.ix_(repeated, repeated)]
    is_determined = np.diagonal(C) > 0
    return OrientationCovariance(
        tuple(unknown for unknown, use in zip(unknowns, is_determined) if use),
        C[np.ix_(is_determined, is_determined)],
    )
