"""Selection of pairs of photographs for matching."""

import dataclasses
from collections.abc import Callable, Sequence
from itertools import combinations

import numpy as np
from jaxtyping import Float

from jaxbundle.tiepoints.features import Features
from jaxbundle.tiepoints.matching import count_matches_of_largest


@dataclasses.dataclass(frozen=True)
class CandidateSettings:
    """Settings of the selection of pairs: a needless pair costs one matching run; a missed pair
    loses a connection."""

    all_pairs_up_to: int = 60
    """Maximum number of photographs with all pairs matched: 1770 pairs, each a product of two
    [6000, 128] matrices. Choosing fewer pays only beyond that."""
    sequence_neighbours: int = 5
    """Neighbours of a photograph on each side in a sequence: of six photographs with 80 % forward
    overlap the first and the last still touch."""
    neighbours: int = 20
    """Neighbours of a photograph, by position or by similarity: in a block of parallel strips those
    of the own strip and of two on each side. More: all pairs, in the end; fewer: strips come
    apart."""
    min_matches: int = 4
    """Minimum matches of the largest features for a candidate pair. Low, since the verification
    rejects a needless candidate."""
    largest_features: int = 800
    """Number of largest features that decide whether two photographs may overlap. The time of this
    check grows with the square, and with that of the number of photographs."""


def candidate_pairs(
    features: Sequence[Features],
    method: str = "auto",
    place: Float[np.ndarray, "photographs 3"] | None = None,
    run: Callable = map,
    settings: CandidateSettings = CandidateSettings(),
) -> list[tuple[int, int]]:
    """Pairs of photographs to match.

    **Arguments:** `method`: `"all"`; `"sequence"`: neighbours in the order given; `"place"`: the
    nearest by the positions in their files, `"alike"` where any is unknown; `"alike"`: those whose
    largest features match; `"auto"`: all of a few; of many as `"place"`. `place`: positions, NaN:
    unknown; `run`: maps a function over many.
    """
    n = len(features)
    has_places = place is not None and np.isfinite(place).all()
    if method == "auto":
        method = "all" if n <= settings.all_pairs_up_to else "place" if has_places else "alike"
    if method == "all":
        return list(combinations(range(n), 2))
    if method == "sequence":
        neighbours = settings.sequence_neighbours
        return [(i, j) for i in range(n) for j in range(i + 1, min(i + neighbours + 1, n))]
    if method == "place" and has_places:
        return _nearest_by_position(np.asarray(place), settings.neighbours)
    return _most_similar(features, run, settings)


def _nearest_by_position(
    place: Float[np.ndarray, "photographs 3"], neighbours: int
) -> list[tuple[int, int]]:
    from scipy.spatial import cKDTree

    # One more: the nearest of each photograph is the photograph itself.
    _, rows = cKDTree(place).query(place, k=min(neighbours + 1, len(place)))
    pairs = {(min(i, j), max(i, j)) for i, row in enumerate(rows) for j in row.tolist() if i != j}
    return sorted(pairs)


def _most_similar(
    features: Sequence[Features], run: Callable, settings: CandidateSettings
) -> list[tuple[int, int]]:
    all_pairs = list(combinations(range(len(features)), 2))
    max_features = settings.largest_features
    count = lambda pair: count_matches_of_largest(
        features[pair[0]], features[pair[1]], max_features
    )
    similar = [[] for _ in features]
    for (i, j), number in zip(all_pairs, run(count, all_pairs)):
        if number >= settings.min_matches:
            similar[i].append((number, j))
            similar[j].append((number, i))
    pairs = {
        (min(i, j), max(i, j))
        for i, best in enumerate(similar)
        for _, j in sorted(best, reverse=True)[: settings.neighbours]
    }
    return sorted(pairs)
