"""The open part of the datum in words."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from jaxbundle.network.columns import count
from jaxbundle.network.motions import SIMILARITY


def open_directions_in_words(
    gauge: Float[np.ndarray, "7 defect"],
    centre: Sequence[float] | Float[np.ndarray, "3"] = (0.0, 0.0, 0.0),
) -> str:
    """Which of shift, rotation and scale the observations leave open, for messages.

    Rotation and scale are about the point `centre`: with one point known, no shift is open."""
    # Of unit size, largest element first: squares of very large or small motions are no numbers.
    gauge = np.array(gauge)
    gauge /= np.abs(gauge).max(axis=0)
    gauge[:3] += np.cross(gauge[3:6].T, centre).T + np.outer(centre, gauge[6])
    q, _ = np.linalg.qr(gauge / np.linalg.norm(gauge, axis=0)) if gauge.size else (gauge, None)
    # The norm of a row is the part of that motion in the open ones, from 0 to 1: what belongs to
    # them by less than a tenth is not named.
    parts = [name for name, row in zip(SIMILARITY.names, q) if np.linalg.norm(row) > 0.1]
    words, defect = ", ".join(parts), gauge.shape[1]
    if len(parts) > defect:  # as when scale and a shift compensate each other
        return f"{count(defect, 'combination')} of {words}"
    return words or "none"
