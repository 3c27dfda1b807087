"""Attitudes measured by drones as observations of the network, if they agree with it.

Attitudes rotated by a mounting, a firmware or another convention would spoil a network that does
not need them. So they are first compared with the orientations from the photographs and their
positions, and all are left out if they differ by more than `LARGEST_MEDIAN` of their σ.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jaxbundle.network.build import make_further
from jaxbundle.network.tables import Network
from jaxbundle.orientation import many
from jaxbundle.photographs.xmp import Attitude, rotation_of

LARGEST_MEDIAN = 3.0
"""Largest median of the differences, in units of their σ."""
FEWEST = 3


class Attitudes(NamedTuple):
    """M from the map system to the camera, and its σ about every axis, radians; NaN: unknown."""

    M: Float[np.ndarray, "n 3 3"]
    sigma: Float[np.ndarray, " n"]


def map_attitudes(
    measured: Sequence[Attitude | None], convergence: Float[np.ndarray, " n"]
) -> Attitudes | None:
    """The attitudes in the map system; None if fewer than three are known."""
    M, sigma = np.full((len(measured), 3, 3), np.nan), np.full(len(measured), np.nan)
    for k, attitude in enumerate(measured):
        if attitude is not None and np.isfinite(convergence[k]):
            M[k], sigma[k] = rotation_of(attitude, convergence[k]), np.radians(attitude.sigma)
    return Attitudes(M, sigma) if np.isfinite(sigma).sum() >= FEWEST else None


def with_attitudes(
    network: Network, names: Sequence[str], attitudes: Attitudes | None
) -> tuple[Network, str]:
    """The oriented network with its attitudes as observations, or without; and a note.

    **Arguments:** `names` of the photographs, in the order of the attitudes.
    """
    if attitudes is None:
        return network, ""
    rows = np.array([names.index(id) for id in network.images.id])
    known = np.isfinite(attitudes.sigma[rows]) & np.isfinite(network.images.angles).all(1)
    if known.sum() < FEWEST:
        return network, ""
    M, sigma = attitudes.M[rows[known]], attitudes.sigma[rows[known]]
    found = np.asarray(many.matrices(network.images.angles[known]))
    cosine = (np.einsum("nij,nij->n", M, found) - 1) / 2
    off = np.arccos(np.clip(cosine, -1, 1))
    if np.median(off / sigma) > LARGEST_MEDIAN:
        return network, (
            f"attitudes in the files are off by {np.degrees(np.median(off)):.0f} degrees (median) "
            "from those of the photographs and their positions: not used"
        )
    angles = np.asarray(many.angles(M))
    columns = {"image": [network.images.id[k] for k in np.flatnonzero(known)]}
    columns |= {axis: angles[:, k] for k, axis in enumerate(("omega", "phi", "kappa"))}
    columns |= {f"s{axis}": sigma for axis in ("omega", "phi", "kappa")}
    further = make_further({"attitudes": columns}, 1.0)
    differences = f"{np.degrees(np.median(off)):.1f} degrees"
    note = f"attitudes of {known.sum()} photographs in the files; median difference {differences}"
    return network.replace(further=(*network.further, *further)), note
