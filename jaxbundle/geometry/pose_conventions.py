"""Exterior orientations as other programs write them.

    computer vision    x right, y down, looks along +z    R = D·M,  t = −R·X0,  D = diag(1, −1, −1)
    Bundler, BAL       x right, y up, looks along −z      R = M,    t = −M·X0

with x_camera = R·X + t and M, X0 of the collinearity equations, [r, s, q] = M·(X − X0).

For one pose or a batch of them, in NumPy or JAX arrays.
"""

from typing import TypeVar

import numpy as np
from jax import Array
from jaxtyping import Float

D = np.array([1.0, -1.0, -1.0])
Kind = TypeVar("Kind", Array, np.ndarray)
"""NumPy in, NumPy out; JAX in, JAX out."""


def flip_rows(matrix: Float[Kind, "*batch 3 3"]) -> Float[Kind, "*batch 3 3"]:
    """D·M: between the camera frames of photogrammetry and computer vision, either way."""
    return matrix * D[:, None]


def cv_pose(
    M: Float[Kind, "*batch 3 3"], X0: Float[Kind, "*batch 3"]
) -> tuple[Float[Kind, "*batch 3 3"], Float[Kind, "*batch 3"]]:
    """R and t of computer vision."""
    return bundler_pose(flip_rows(M), X0)


def exterior_from_cv(
    R: Float[Kind, "*batch 3 3"], t: Float[Kind, "*batch 3"]
) -> tuple[Float[Kind, "*batch 3 3"], Float[Kind, "*batch 3"]]:
    """M and X0, the inverse of `cv_pose`."""
    M, X0 = exterior_from_bundler(R, t)
    return flip_rows(M), X0


def bundler_pose(
    M: Float[Kind, "*batch 3 3"], X0: Float[Kind, "*batch 3"]
) -> tuple[Float[Kind, "*batch 3 3"], Float[Kind, "*batch 3"]]:
    """R and t of Bundler and BAL."""
    return M, -(M @ X0[..., None])[..., 0]


def exterior_from_bundler(
    R: Float[Kind, "*batch 3 3"], t: Float[Kind, "*batch 3"]
) -> tuple[Float[Kind, "*batch 3 3"], Float[Kind, "*batch 3"]]:
    """M and X0, the inverse of `bundler_pose`."""
    return R, -(R.mT @ t[..., None])[..., 0]
