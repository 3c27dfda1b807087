"""Principal axes of points: the directions of their largest and smallest extents."""

import numpy as np
from jaxtyping import Float


def principal_axes(
    X: Float[np.ndarray, "n m"],
) -> tuple[Float[np.ndarray, " m"], Float[np.ndarray, "m m"]]:
    """Extents and axes (rows) of points about the origin, the longest first: singular values and
    right singular vectors of X.

    All m, of fewer points as well: the others are zero, and their axes complete the frame.
    """
    # With rows of zeros the thin decomposition has all axes. NumPy's full one has the left vectors,
    # too: 3 GB for 20 000 points.
    missing = max(X.shape[1] - len(X), 0)
    _, extents, axes = np.linalg.svd(np.pad(X, ((0, missing), (0, 0))), full_matrices=False)
    return extents, axes
