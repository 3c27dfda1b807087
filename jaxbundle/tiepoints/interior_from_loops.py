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

from jaxbundle.tiepoints.pair_graph import label_connected
from jaxbundle.tiepoints.verification import Pair, loop_misclosure, refine_rotations


@dataclasses.dataclass(frozen=True)
class ClosureSettings:
    """Settings of the search for the interior orientation with which rotations close."""

    sigma_rotation: float = np.radians(0.3)
    """ω₀, the error of ω of right pairs, radians: of three rotations with 0.17 degrees each.
    Smaller: with a first camera that is a few per cent wrong all loops count as wrong, and the sum
    is flat; larger: wrong loops take part in the result."""
    sigma_log_distance: float = 0.25
    """σ of ln c about the value stated by the files, or else the start value. Weak on purpose: it
    decides only where loops do not."""
    sigma_k1: float = 0.15
    """σ of K1 about zero: that of most lenses is between −0.3 and 0.1."""
    first_factors: tuple[float, ...] = (1.0, 1.25, 0.8)
    """First principal distances, relative to the start value: one σ of ln c on either side."""
    step_log_distance: float = 0.1
    """First step of the search in ln c, less than half its σ."""
    step_k1: float = 0.04
    """First step of the search in K1, about a quarter of its σ."""
    last_step: float = 0.01
    """Size of the last steps, in ln c, K1 and the sum: the adjustment estimates both anew, and
    starts from values that are a few per cent wrong."""
    max_evaluations: int = 40
    """Maximum evaluations of one search, each a refinement of all pairs. A search that is cut
    off has come nearer, and the adjustment estimates both anew."""
    clear_sum: float = 0.5
    """Sum per independent loop below which no other first principal distance is tried: that of
    loops with ω = 0.8·ω₀."""
    min_loops: int = 3
    """Minimum number of independent loops, one more than the two unknowns: four photographs with
    all their pairs."""


# ln c and K1.
Interior = Float[np.ndarray, "2"]


@dataclasses.dataclass(frozen=True)
class OrientedPairs:
    """Pairs oriented with a camera, and the coordinates, c = 1, of their matches with another."""

    pairs: Sequence[Pair]
    ideal_with: Callable[[Interior], Sequence[tuple[np.ndarray, np.ndarray]]]


def close_rotations(
    orient: Callable[[Interior], OrientedPairs],
    start: Interior,
    middle: float | None = None,
    settings: ClosureSettings = ClosureSettings(),
) -> Interior:
    """ln c and K1 with which rotations close; the start value if there are too few loops.

    **Arguments:** `orient`: orients the pairs robustly with an interior orientation; `middle`: the
    ln c about which ln c is weighted (`sigma_log_distance`); default: that of `start`.
    """
    middle = float(start[0]) if middle is None else middle
    minima = []
    for factor in settings.first_factors:
        first_start = start + [np.log(factor), 0.0]
        minimum = _search(orient(first_start), first_start, middle, settings)
        if minimum is not None:
            if minimum.per_loop < settings.clear_sum:
                return minimum.interior
            minima.append(minimum)
    if not minima:
        return start
    # With a wrong camera few pairs are oriented, and a few loops may close by chance: only minima
    # with more than half of the largest number of loops are compared.
    largest_number = max(minimum.independent for minimum in minima)
    with_many = [minimum for minimum in minima if 2 * minimum.independent > largest_number]
    best = min(with_many, key=lambda minimum: minimum.per_loop).interior
    searched_again = _search(orient(best), best, middle, settings)
    return best if searched_again is None else searched_again.interior


class ClosureMinimum(NamedTuple):
    """A minimum, the sum per independent loop, and the number of independent loops."""

    interior: Interior
    per_loop: float
    independent: int


def _search(
    oriented: OrientedPairs, start: Interior, middle: float, settings: ClosureSettings
) -> ClosureMinimum | None:
    """The minimum next to a first interior orientation; None with too few loops."""
    from scipy.optimize import minimize

    pairs = oriented.pairs
    loops = find_loops([pair.images for pair in pairs])
    independent = count_independent([pairs[k].images for k in np.unique(loops)])
    if independent < settings.min_loops:
        return None

    def total(x: Interior) -> float:
        M = refine_rotations(pairs, oriented.ideal_with(x))
        ij, jk, ik = (M[column] for column in loops.T)
        # A pair that cannot be refined with this camera counts as a half turn.
        angle = np.nan_to_num(loop_misclosure(ij, jk, ik), nan=np.pi)
        misclosure = independent * np.log1p((angle / settings.sigma_rotation) ** 2).mean()
        deviations = (x[0] - middle) / settings.sigma_log_distance, x[1] / settings.sigma_k1
        return misclosure + deviations[0] ** 2 + deviations[1] ** 2

    # Without derivatives: each evaluation refines every pair anew (and may lose rays at the
    # border), and the sum has kinks where wrong loops close.
    simplex = start + np.array([[0, 0], [settings.step_log_distance, 0], [0, settings.step_k1]])
    minimum = minimize(
        total,
        start,
        method="Nelder-Mead",
        options={
            "initial_simplex": simplex,
            "xatol": settings.last_step,
            "fatol": settings.last_step,
            "maxfev": settings.max_evaluations,
        },
    )
    return ClosureMinimum(minimum.x, float(minimum.fun) / independent, independent)


def count_independent(pairs: Sequence[tuple[int, int]]) -> int:
    """The number of independent loops of pairs: edges − nodes + connected components, the
    dimension of the cycle space of a graph."""
    if not len(pairs):
        return 0
    photographs, ends = np.unique(np.reshape(pairs, (-1, 2)), return_inverse=True)
    groups = label_connected(len(photographs), ends.reshape(-1, 2).tolist()).max() + 1
    return int(len(pairs) - len(photographs) + groups)


def find_loops(pairs: Sequence[tuple[int, int]]) -> Int[np.ndarray, "loops 3"]:
    """Positions of the pairs ij, jk and ik of every three photographs that have them; each pair
    (i, j) has i < j."""
    row = {pair: k for k, pair in enumerate(pairs)}
    successors: dict[int, set[int]] = {}
    for i, j in pairs:
        successors.setdefault(i, set()).add(j)
    loops = [
        (row[i, j], row[j, k], row[i, k])
        for i, j in pairs
        for k in sorted(successors[i] & successors.get(j, set()))
    ]
    return np.array(loops, int).reshape(-1, 3)
