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
    for noun, ids, owner_of_ray, counterpart_of_ray, remedy in (
        ("image", images.id, rays.image, rays.point, "is it one photograph under two names?"),
        ("point", points.id, rays.point, rays.image, "is it one point under two names?"),
    ):
        pairs = _repetitions(owner_of_ray, counterpart_of_ray, rays.xy)
        if pairs:
            names = list_some((f"{ids[b]!r} repeats {ids[a]!r}" for a, b in pairs), 5, str)
            network = network.warn(
                f"{count(len(pairs), noun)} with the same measurements as another: {names}; "
                f"{remedy} They count twice: remove one"
            )
    return network


def _repetitions(
    owner_of_ray: Int[np.ndarray, " rays"],
    counterpart_of_ray: Int[np.ndarray, " rays"],
    xy: Float[np.ndarray, "rays 2"],
    min_equal: int = 3,
) -> Sequence[tuple[int, int]]:
    """Pairs (first, repetition) whose rows (`counterpart_of_ray`, x, y) are all equal, `min_equal`
    at least: two photographs may have one or two points at the same rounded place by chance.

    Sums of hashed rows, modulo 2⁶⁴ and so in any order, find candidates among millions of points;
    only these are compared row by row."""
    if not len(owner_of_ray):
        return ()
    # Addition commutes, so the sum of the hashes of an image does not depend on the order of its
    # rows; two images with different rows have equal sums once in 2⁶⁴.
    x, y = np.ascontiguousarray(xy.T, float).view(np.uint64)
    hashes = x * MIX[0] ^ (y * MIX[1] + counterpart_of_ray.astype(np.uint64) * MIX[2])
    hashes = (hashes ^ (hashes >> np.uint64(29))) * MIX[0]
    order = np.argsort(owner_of_ray, kind="stable")
    starts = np.flatnonzero(np.diff(owner_of_ray[order], prepend=-1))
    total, number = (
        np.add.reduceat(hashes[order], starts),
        np.diff(np.append(starts, len(owner_of_ray))),
    )
    _, group, size = np.unique(total, return_inverse=True, return_counts=True)
    candidates = owner_of_ray[order[starts]][(size[group] > 1) & (number >= min_equal)]
    rows = np.flatnonzero(np.isin(owner_of_ray, candidates))
    rows = rows[np.lexsort((counterpart_of_ray[rows], owner_of_ray[rows]))]
    first_owners, pairs = {}, []
    for part in (
        np.split(rows, np.flatnonzero(np.diff(owner_of_ray[rows])) + 1) if len(rows) else ()
    ):
        key, owner = (
            (counterpart_of_ray[part].tobytes(), xy[part].tobytes()),
            int(owner_of_ray[part[0]]),
        )
        if (first_owner := first_owners.setdefault(key, owner)) != owner:
            pairs.append((first_owner, owner))
    return pairs
