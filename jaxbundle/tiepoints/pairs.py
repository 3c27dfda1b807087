"""Selection of pairs of photographs for matching."""

from collections.abc import Callable, Sequence
from itertools import combinations

import numpy as np
from jaxtyping import Float

from jaxbundle.tiepoints.features import Features
from jaxbundle.tiepoints.matching import number_alike

ALL_PAIRS_UP_TO = 60
"""Maximum number of photographs with all pairs matched."""
NEXT = 5
"""Neighbours of a photograph on each side in a sequence."""
NEIGHBOURS = 20
"""Number of neighbours of a photograph, by position or by similarity."""
FEWEST_MATCHES = 4
"""Minimum matches of the largest features for a candidate pair."""


def candidate_pairs(
    features: Sequence[Features],
    way: str = "auto",
    place: Float[np.ndarray, "photographs 3"] | None = None,
    run: Callable = map,
) -> list[tuple[int, int]]:
    """Pairs of photographs to match.

    **Arguments:** `way`: `"all"`; `"sequence"`: neighbours in the order given; `"place"`: the
    nearest by the positions in their files; `"alike"`: those whose largest features match;
    `"auto"`: all of a few; of many the nearest if all positions are known, else those alike.
    `place`: positions, NaN: unknown; `run`: maps a function over many.
    """
    n = len(features)
    known = place is not None and np.isfinite(place).all()
    if way == "auto":
        way = "all" if n <= ALL_PAIRS_UP_TO else "place" if known else "alike"
    if way == "all":
        return list(combinations(range(n), 2))
    if way == "sequence":
        return [(i, j) for i in range(n) for j in range(i + 1, min(i + NEXT + 1, n))]
    if way == "place" and known:
        return _nearest(np.asarray(place))
    return _alike(features, run)


def _nearest(place):
    from scipy.spatial import cKDTree

    _, rows = cKDTree(place).query(place, k=min(NEIGHBOURS + 1, len(place)))
    pairs = {(min(i, j), max(i, j)) for i, row in enumerate(rows) for j in row.tolist() if i != j}
    return sorted(pairs)


def _alike(features, run):
    every = list(combinations(range(len(features)), 2))
    number = list(run(lambda pair: number_alike(features[pair[0]], features[pair[1]]), every))
    of = [[] for _ in features]
    for (i, j), found in zip(every, number):
        if found >= FEWEST_MATCHES:
            of[i].append((found, j))
            of[j].append((found, i))
    pairs = {
        (min(i, j), max(i, j))
        for i, best in enumerate(of)
        for _, j in sorted(best, reverse=True)[:NEIGHBOURS]
    }
    return sorted(pairs)
