"""The interior orientation with which rotations close around three photographs.

With a wrong principal distance or K1 a pair can still be oriented: with a flat object or a short
base the coplanarity condition hardly changes. But every rotation is then wrong, and around three
photographs i, j, k

    M_jk·M_ij·M_ikᵀ = rotation by ω ≠ 0.

The following sum, with ω of all loops, is minimised over ln c and K1,

    p·mean ln(1 + (ω/ω₀)²) + ((ln c − ln c₀)/σ_c)² + (K1/σ_K1)²,

where p = pairs − photographs + connected groups of them is the number of independent loops. Loops
of wrong pairs do not close with any camera, and add a constant. Pairs are oriented robustly with a
first camera, and then refined with the matches that agree. The sum has local minima: unless most
loops close, other first principal distances are tried, and pairs are oriented again with the best
result.

Sweeney, Sattler, Höllerer, Turk and Pollefeys (2015), Optimizing the viewing graph for
structure-from-motion, do this with fundamental matrices.
"""

import dataclasses
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from jaxbundle.tiepoints.verification import Pair, rotation_angle, turn_pairs

ANGLE = np.radians(0.3)
"""ω₀, the error of ω of right pairs."""
SIGMA_C, SIGMA_K1 = 0.25, 0.15
"""σ of ln c about the value stated by the files, or else the start value, and of K1 about zero."""
FIRST = (1.0, 1.25, 0.8)
"""First principal distances, relative to the start value."""
STEP_C, STEP_K1 = 0.1, 0.04
"""First steps of the search, in ln c and K1."""
LAST_STEP, EVALUATIONS = 0.01, 40
CLEAR = 0.5
"""Sum per independent loop below which no other first principal distance is tried."""
FEWEST = 3
"""Minimum number of independent loops."""

Interior = Float[np.ndarray, "2"]
"""ln c and K1."""


@dataclasses.dataclass(frozen=True)
class Oriented:
    """Pairs oriented with a camera, and the coordinates, c = 1, of their matches with another."""

    pairs: Sequence[Pair]
    ideal: Callable[[Interior], Sequence[tuple[np.ndarray, np.ndarray]]]


def close_rotations(
    orient: Callable[[Interior], Oriented], start: Interior, middle: float | None = None
) -> Interior:
    """ln c and K1 with which rotations close; the start value if there are too few loops.

    **Arguments:** `orient`: orients the pairs robustly with an interior orientation; `middle`: ln c
    before; default: that of `start`.
    """
    middle = float(start[0]) if middle is None else middle
    found = []
    for factor in FIRST:
        first = start + [np.log(factor), 0.0]
        one = _search(orient(first), first, middle)
        if one is not None:
            if one.sum < CLEAR:
                return one.interior
            found.append(one)
    if not found:
        return start
    most = max(one.loops for one in found)
    best = min((one for one in found if 2 * one.loops > most), key=lambda one: one.sum).interior
    again = _search(orient(best), best, middle)
    return best if again is None else again.interior


class Minimum(NamedTuple):
    """A minimum, the sum per independent loop, and their number."""

    interior: Interior
    sum: float
    loops: int


def _search(oriented: Oriented, first: Interior, middle: float) -> Minimum | None:
    """The minimum next to a first interior orientation; None with too few loops."""
    from scipy.optimize import minimize

    pairs = oriented.pairs
    loops = find_loops([pair.images for pair in pairs])
    independent = count_independent([pairs[k].images for k in np.unique(loops)])
    if independent < FEWEST:
        return None

    def total(x):
        M = turn_pairs(pairs, oriented.ideal(x))
        ij, jk, ik = (M[column] for column in loops.T)
        angle = np.nan_to_num(rotation_angle(jk @ ij @ np.swapaxes(ik, 1, 2)), nan=np.pi)
        misclosure = independent * np.log1p((angle / ANGLE) ** 2).mean()
        return misclosure + ((x[0] - middle) / SIGMA_C) ** 2 + (x[1] / SIGMA_K1) ** 2

    simplex = first + np.array([[0, 0], [STEP_C, 0], [0, STEP_K1]])
    found = minimize(
        total,
        first,
        method="Nelder-Mead",
        options={
            "initial_simplex": simplex,
            "xatol": LAST_STEP,
            "fatol": LAST_STEP,
            "maxfev": EVALUATIONS,
        },
    )
    return Minimum(found.x, float(found.fun) / independent, independent)


def count_independent(pairs: Sequence[tuple[int, int]]) -> int:
    """The number of independent loops of pairs."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    photographs, ends = np.unique(np.reshape(pairs, (-1, 2)), return_inverse=True)
    shape = (len(photographs), len(photographs))
    if not len(pairs):
        return 0
    i, j = ends.reshape(-1, 2).T
    groups, _ = connected_components(coo_array((np.ones(len(i)), (i, j)), shape), directed=False)
    return len(pairs) - len(photographs) + groups


def find_loops(pairs: Sequence[tuple[int, int]]) -> Int[np.ndarray, "loops 3"]:
    """Positions of the pairs ij, jk and ik of every three photographs that have them."""
    row = {pair: k for k, pair in enumerate(pairs)}
    after: dict[int, set[int]] = {}
    for i, j in pairs:
        after.setdefault(i, set()).add(j)
    found = [
        (row[i, j], row[j, k], row[i, k])
        for i, j in pairs
        for k in sorted(after[i] & after.get(j, set()))
    ]
    return np.array(found, int).reshape(-1, 3)
