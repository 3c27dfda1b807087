"""The same measurements under two names: an image, or a point, that repeats another.

They count twice in σ, and a point as well as its repetition is a second opinion of nothing.
"""

from collections.abc import Sequence

import numpy as np

from jaxbundle.network.columns import count, some
from jaxbundle.network.tables import Network

LEAST = 3
"""Image points that agree to the last digit before an image repeats another; of a point, images."""


def warn_of_repetitions(network: Network) -> Network:
    """The network with a warning for images, and points, whose measurements are those of others."""
    rays, images, points = network.observations, network.images, network.points
    for thing, ids, of, by, remedy in (
        ("image", images.id, rays.image, rays.point, "is it one photograph under two names?"),
        ("point", points.id, rays.point, rays.image, "is it one point under two names?"),
    ):
        pairs = _repetitions(of, by, rays.xy)
        if pairs:
            names = some((f"{ids[b]!r} repeats {ids[a]!r}" for a, b in pairs), 5, str)
            network = network.warn(
                f"{count(len(pairs), thing)} with the same measurements as another: {names}; "
                f"{remedy} They count twice: remove one"
            )
    return network


def _repetitions(of, by, xy) -> Sequence[tuple[int, int]]:
    """(first, repetition) of the things whose rows (`by`, x, y) are all the same.

    Sums of x and y find candidates among millions of points; only these are compared row by row."""
    number = np.bincount(of)
    sums = np.stack([number, *(np.bincount(of, column) for column in (by, *xy.T))], 1)
    things = np.flatnonzero(number >= LEAST)
    _, group, size = np.unique(sums[things], axis=0, return_inverse=True, return_counts=True)
    candidates = things[size[group.ravel()] > 1]
    known, found = {}, []
    for thing in candidates.tolist():
        rows = np.flatnonzero(of == thing)
        rows = rows[np.argsort(by[rows])]
        key = by[rows].tobytes(), xy[rows].tobytes()
        if (same := known.setdefault(key, thing)) != thing:
            found.append((same, thing))
    return found
