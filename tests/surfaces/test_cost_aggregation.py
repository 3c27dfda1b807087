"""Semi-global aggregation against its equation, node by node."""

import numpy as np

from jaxbundle.surfaces.cost_aggregation import aggregate

SMALL, LARGE = 0.3, 0.8


def path_costs(cost, direction):
    """L(p, d) of Hirschmüller (2008), equation 13, by recursion from node to node."""
    L = np.full(cost.shape, np.nan)

    def cost_of(p):
        before = tuple(np.subtract(p, direction))
        if not all(0 <= a < n for a, n in zip(before, cost.shape)):
            return cost[p]
        if np.isnan(L[before]).any():
            L[before] = cost_of(before)
        came, least = L[before], L[before].min()
        ways = [came, np.full_like(came, least + LARGE)]
        ways += [np.append(came[1:], np.inf) + SMALL, np.append(np.inf, came[:-1]) + SMALL]
        return cost[p] + np.min(ways, axis=0) - least

    for p in np.ndindex(cost.shape[:2]):
        L[p] = cost_of(p)
    return L


def test_the_sum_of_all_eight_paths():
    cost = np.random.default_rng(3).uniform(size=(5, 7, 6))
    directions = [(a, b) for a in (-1, 0, 1) for b in (-1, 0, 1) if (a, b) != (0, 0)]
    expected = sum(path_costs(cost, direction) for direction in directions)
    np.testing.assert_allclose(aggregate(cost, SMALL, LARGE), expected)
