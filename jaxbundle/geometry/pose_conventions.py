"""Exterior orientations as other programs write them.

    computer vision    x right, y down, looks along +z    R = D·M,  t = −R·X0,  D = diag(1, −1, −1)
    Bundler, BAL       x right, y up, looks along −z      R = M,    t = −M·X0

with x_camera = R·X + t and M, X0 of the collinearity equations, [r, s, q] = M·(X − X0).

For one pose or a batch of them, in NumPy or JAX arrays.
"""

import numpy as np
from jaxtyping import Array, Float

D = np.array([1.0, -1.0, -1.0])
Matrix = Float[Array, "*batch 3 3"]
Vector = Float[Array, "*batch 3"]


def flip_rows(matrix: Matrix) -> Matrix:
    """D·M: between the camera frames of photogrammetry and computer vision, either way."""
    return matrix * D[:, None]


def cv_pose(M: Matrix, X0: Vector) -> tuple[Matrix, Vector]:
    """R and t of computer vision."""
    return bundler_pose(flip_rows(M), X0)


def exterior_from_cv(R: Matrix, t: Vector) -> tuple[Matrix, Vector]:
    """M and X0, the inverse of `cv_pose`."""
    M, X0 = exterior_from_bundler(R, t)
    return flip_rows(M), X0


def bundler_pose(M: Matrix, X0: Vector) -> tuple[Matrix, Vector]:
    """R and t of Bundler and BAL."""
    return M, -(M @ X0[..., None])[..., 0]


def exterior_from_bundler(R: Matrix, t: Vector) -> tuple[Matrix, Vector]:
    """M and X0, the inverse of `bundler_pose`."""
    return R, -(R.mT @ t[..., None])[..., 0]
