"""The graph of pairs: which photographs they connect."""

from collections.abc import Collection, Sequence

import numpy as np
from jaxtyping import Int


def label_connected(
    number: int, pairs: Collection[Sequence[int]]
) -> Int[np.ndarray, " photographs"]:
    """A label for each of a number of photographs; those connected by pairs, directly or in a
    chain, have the same."""
    from scipy.sparse import coo_array  # imported here: a tenth of a second
    from scipy.sparse.csgraph import connected_components

    i, j = np.reshape(np.array(list(pairs), int), (-1, 2)).T
    graph = coo_array((np.ones(len(i)), (i, j)), (number, number))
    return connected_components(graph, directed=False)[1]
