"""What the views of a camera do not determine: parameters that a status alone does not name.

A singular camera has directions of its interior orientation in which the normal equations, scaled
by their diagonal before the elimination of the views, vanish; the parameters involved are named. If
the noise of the measurements makes the equations solvable, the σ of the result show it: views of a
board all parallel to the image determine neither principal distance nor distances, and the σ of fx
is as large as fx.
"""

import numpy as np
from jaxtyping import Bool, Float

from jaxbundle.batch.camera import INDETERMINATE
from jaxbundle.cameras import CameraModel
from jaxbundle.leastsquares.quality.weakness import VAGUE_RATIO

SMALLEST_PART = 0.05
"""A parameter with this part of the square of a vanishing direction is named."""


def is_vague(
    model: CameraModel,
    free: tuple[int, ...],
    interior: Float[np.ndarray, "cameras parameters"],
    sigma: Float[np.ndarray, "cameras k"],
) -> Bool[np.ndarray, "cameras k"]:
    """Principal distances and points with a σ above a fiftieth of the principal distance.

    Distortion coefficients never count: an insignificant one has a σ larger than itself.
    """
    columns = [model.parameters.index(name) for name in model.principal_distance]
    shortest = np.abs(interior[:, columns]).min(1)
    of_these = {model.parameters.index(name) for name in model.core}
    return ~(VAGUE_RATIO * sigma <= shortest[:, None]) & [column in of_these for column in free]


def vanishing(reduced: Float[np.ndarray, "cameras k k"]) -> Bool[np.ndarray, "cameras k"]:
    """Parameters with part in the null space of the scaled reduced normal matrix."""
    finite = np.all(np.isfinite(reduced), axis=(1, 2))
    values, vectors = np.linalg.eigh(np.where(finite[:, None, None], reduced, 0.0))
    null = values < INDETERMINATE
    share = np.einsum("cij,cj->ci", vectors**2, null.astype(float))
    return finite[:, None] & (share > SMALLEST_PART)
