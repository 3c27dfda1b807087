"""Attitudes measured by drones as observations of the network, if they agree with it.

Attitudes rotated by a mounting, a firmware or another convention would spoil a network that does
not need them. So they are first compared with the orientations from the photographs and their
positions, and all are left out if the median of the differences is above 3 σ.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jaxbundle.network.build import make_further
from jaxbundle.network.tables import Network
from jaxbundle.orientation import batched
from jaxbundle.photographs.xmp import CameraAttitude, rotation_of

# Minimum known attitudes: of two, the median of the differences is the mean of both, and one wrong
# attitude refuses a right one.
MIN_ATTITUDES = 3


class MapAttitudes(NamedTuple):
    """M from the map system to the camera, and its σ about every axis, radians; NaN: unknown."""

    M: Float[np.ndarray, "n 3 3"]
    sigma: Float[np.ndarray, " n"]


def map_attitudes(
    measured: Sequence[CameraAttitude | None], convergence: Float[np.ndarray, " n"]
) -> MapAttitudes | None:
    """The attitudes in the map system; None if fewer than three are known."""
    M, sigma = np.full((len(measured), 3, 3), np.nan), np.full(len(measured), np.nan)
    for k, attitude in enumerate(measured):
        if attitude is not None and np.isfinite(convergence[k]):
            M[k], sigma[k] = rotation_of(attitude, convergence[k]), np.radians(attitude.sigma)
    return MapAttitudes(M, sigma) if np.isfinite(sigma).sum() >= MIN_ATTITUDES else None


def with_attitudes(
    network: Network, names: Sequence[str], attitudes: MapAttitudes | None
) -> tuple[Network, str]:
    """The oriented network with its attitudes as observations, or without; and a note.

    **Arguments:** `names` of the photographs, in the order of the attitudes.
    """
    if attitudes is None:
        return network, ""
    rows = np.array([names.index(id) for id in network.images.id])
    is_known = np.isfinite(attitudes.sigma[rows]) & np.isfinite(network.images.angles).all(1)
    if is_known.sum() < MIN_ATTITUDES:
        return network, ""
    M, sigma = attitudes.M[rows[is_known]], attitudes.sigma[rows[is_known]]
    oriented = np.asarray(batched.matrices(network.images.angles[is_known]))
    # The angle of M·M'ᵀ: 2·cos α + 1 = tr(M·M'ᵀ).
    cosine = (np.einsum("nij,nij->n", M, oriented) - 1) / 2
    deviation = np.arccos(np.clip(cosine, -1, 1))
    # Angles of right attitudes with σ about three axes have the median 1.54 σ; one constant
    # rotation, as of a mounting, makes all of them large. With the limit 3, σ may be stated 1.9
    # times too small.
    if np.median(deviation / sigma) > 3:
        return network, (
            f"attitudes in the files are off by {np.degrees(np.median(deviation)):.0f} degrees "
            "(median) from those of the photographs and their positions: not used"
        )
    # One σ about all axes: the largest that the file states.
    angles = np.asarray(batched.angles(M))
    columns = {"image": [network.images.id[k] for k in np.flatnonzero(is_known)]}
    columns |= {axis: angles[:, k] for k, axis in enumerate(("omega", "phi", "kappa"))}
    columns |= {f"s{axis}": sigma for axis in ("omega", "phi", "kappa")}
    kinds = make_further({"attitudes": columns}, 1.0)
    differences = f"{np.degrees(np.median(deviation)):.1f} degrees"
    note = (
        f"attitudes of {is_known.sum()} photographs in the files; median difference {differences}"
    )
    return network.replace(further=(*network.further, *kinds)), note
