"""The same measurements under two names: an image, or a point, that repeats another.

They count twice in σ, and the repetition is no independent information.
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Int

from jaxbundle.network.columns import count, list_some
from jaxbundle.network.tables import Network

# Odd numbers that spread the bits of measurements over a hash.
MIX = np.array([0x9E3779B97F4A7C15, 0xC2B2AE3D27D4EB4F, 0x165667B19E3779F9], np.uint64)


def warn_of_repetitions(network: Network) -> Network:
    """The network with a warning for images and points that repeat the measurements of others."""
    rays, images, points = network.observations, network.images, network.points
    for noun, ids, owner, partner, remedy in (
        ("image", images.id, rays.image, rays.point, "is it one photograph under two names?"),
        ("point", points.id, rays.point, rays.image, "is it one point under two names?"),
    ):
        pairs = _repetitions(owner, partner, rays.xy)
        if pairs:
            names = list_some((f"{ids[b]!r} repeats {ids[a]!r}" for a, b in pairs), 5, str)
            network = network.warn(
                f"{count(len(pairs), noun)} with the same measurements as another: {names}; "
                f"{remedy} They count twice: remove one"
            )
    return network


def _repetitions(
    owner: Int[np.ndarray, " rays"],
    partner: Int[np.ndarray, " rays"],
    xy: Float[np.ndarray, "rays 2"],
    min_equal: int = 3,
) -> Sequence[tuple[int, int]]:
    """Pairs (first, repetition) whose rows (`partner`, x, y) are all equal, `min_equal` at least:
    two photographs may have one or two points at the same rounded place by chance.

    Sums of hashed rows, modulo 2⁶⁴ and so in any order, find candidates among millions of points;
    only these are compared row by row."""
    if not len(owner):
        return ()
    # Addition commutes, so the sum of the hashes of an image does not depend on the order of its
    # rows; two images with different rows have equal sums once in 2⁶⁴.
    x, y = np.ascontiguousarray(xy.T, float).view(np.uint64)
    mixed = x * MIX[0] ^ (y * MIX[1] + partner.astype(np.uint64) * MIX[2])
    mixed = (mixed ^ (mixed >> np.uint64(29))) * MIX[0]
    order = np.argsort(owner, kind="stable")
    begin = np.flatnonzero(np.diff(owner[order], prepend=-1))
    total, number = np.add.reduceat(mixed[order], begin), np.diff(np.append(begin, len(owner)))
    _, group, size = np.unique(total, return_inverse=True, return_counts=True)
    candidates = owner[order[begin]][(size[group] > 1) & (number >= min_equal)]
    rows = np.flatnonzero(np.isin(owner, candidates))
    rows = rows[np.lexsort((partner[rows], owner[rows]))]
    first_owner, repetitions = {}, []
    for part in np.split(rows, np.flatnonzero(np.diff(owner[rows])) + 1) if len(rows) else ():
        key, this_owner = (partner[part].tobytes(), xy[part].tobytes()), int(owner[part[0]])
        if (earlier_owner := first_owner.setdefault(key, this_owner)) != this_owner:
            repetitions.append((earlier_owner, this_owner))
    return repetitions
