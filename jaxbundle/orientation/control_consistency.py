"""Control points that contradict the others, by leave-one-out prediction; σ of control estimated.

Photographs, tie points and satellite positions determine the control points; d: their coordinates
minus the given ones, C: the joint covariance of these determined coordinates (with the offset of
the system), Σ: the covariance of control. With S = C + Σ, and W = S⁻¹ without what the columns of
G leave open (position, orientation, scale of a block without positions),

    W = S⁻¹ − S⁻¹·G·(Gᵀ·S⁻¹·G)⁻¹·Gᵀ·S⁻¹,

the error of the prediction of points D from all others, and its covariance, are

    e = W_DD⁻¹·(W·d)_D,        Σ_e = W_DD⁻¹,        T = eᵀ·Σ_e⁻¹·e

(the deletion residual of generalised least squares; Cook and Weisberg 1982, 2.2), tested for the
plane and for heights, of which the smaller probability counts twice. With given σ, T is χ²
distributed. Unknown σ are restricted maximum likelihood estimates (Förstner 1979): the fixed
point of σ² ← σ²·(dᵀ·W·D·W·d)/tr(W·D), from the points not tested; T then follows F.
"""

import dataclasses
import itertools
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxbundle.leastsquares.quality.distributions import (
    NORMAL_SIGMA_BY_MAD,
    chi2_tail,
    f_tail,
    level_of_one,
)

# With at most this many points two are also tested together: two errors of one size, as of
# exchanged names, hide each other in the estimated σ of a few points. Of 20 points there are 190
# pairs, each with a σ estimated anew.
MAX_POINTS_FOR_PAIRS = 20
# Control points that remain at least: three of a similarity always nearly agree.
MIN_AGREEING = 4
# Of an estimated σ that tests points: its relative σ is 1/√(2·redundancy), 40 %.
MIN_REDUNDANCY_OF_TEST = 3.0


@dataclasses.dataclass(frozen=True)
class Discrepancies:
    """Determined minus given coordinates of control points.

    **Fields:** `difference` [n, 3]; `covariance` [n, 3, n, 3] of it, without that of
    control; `sigma` [n, 3] of control: NaN where it is to be estimated, infinite on axes that are
    not controlled; `open_motions` [n, 3, k] of the points, which the block leaves open."""

    difference: Float[np.ndarray, "n 3"]
    covariance: Float[np.ndarray, "n 3 n 3"]
    sigma: Float[np.ndarray, "n 3"]
    open_motions: Float[np.ndarray, "n 3 k"]

    def __len__(self) -> int:
        return len(self.difference)


@dataclasses.dataclass(frozen=True)
class Assessment:
    """Which points are `used`; the σ of control [n, 3], estimated where it was not given, with its
    `redundancy` in the plane and in height; for every point the error of its prediction from the
    others used, its σ [n, 3] and the probability of a larger one (NaN if it cannot be predicted).
    `assumed`: whether σ is the assumed one, in the plane and in height.

    `factor`: given σ were multiplied by it, because hardly any
    point agrees with them."""

    used: Bool[np.ndarray, " n"]
    sigma: Float[np.ndarray, "n 3"]
    redundancy: tuple[float, float]
    error: Float[np.ndarray, "n 3"]
    error_sigma: Float[np.ndarray, "n 3"]
    probability: Float[np.ndarray, " n"]
    assumed: tuple[bool, bool]
    factor: float = 1.0


def assess(discrepancies: Discrepancies, assumed: float, significance: float = 0.05) -> Assessment:
    """Find the control points that contradict the others.

    The most improbable point, or pair of points, is left out while its probability is below the
    level for as many tests; finally those that the remaining ones predict well are used again. At
    least half of the points stay, and four: if half of them or more contradict their given σ, and
    some that stay do as well, these are wrong, and all are multiplied by one factor.

    **Arguments:** `assumed`: σ if the points do not determine it, and the smallest estimated one;
    `significance`: probability of suspecting any point of control without contradictions.
    """
    if not len(discrepancies):
        no_values, both_assumed = np.zeros((0, 3)), (True, True)
        return Assessment(
            np.zeros(0, bool),
            no_values,
            (0.0, 0.0),
            no_values,
            no_values,
            np.zeros(0),
            both_assumed,
        )
    is_used, most_contradict = _search(discrepancies, assumed, significance)
    factor = 1.0
    if most_contradict and np.isfinite(discrepancies.sigma).any():
        everything = np.ones(len(discrepancies), bool)
        sigma, *_ = _resolve(discrepancies, everything, assumed)
        W, d, rows = _weight_matrix(discrepancies, sigma, everything)
        redundancy = len(rows) - discrepancies.open_motions.shape[2]
        factor = float(np.sqrt(max(d @ W @ d / max(redundancy, 1), 1.0)))
        scaled = np.where(
            np.isfinite(discrepancies.sigma), discrepancies.sigma * factor, discrepancies.sigma
        )
        discrepancies = dataclasses.replace(discrepancies, sigma=scaled)
        is_used, _ = _search(discrepancies, assumed, significance)
    sigma, redundancy, guessed = _resolve(discrepancies, is_used, assumed)
    error, error_sigma = np.full((2, len(discrepancies), 3), np.nan)
    probability = np.full(len(discrepancies), np.nan)
    common = (
        _linearise(discrepancies, is_used, is_used, assumed)
        if is_used.sum() > MAX_POINTS_FOR_PAIRS
        else None
    )
    for i in range(len(discrepancies)):
        test = _predict(discrepancies, is_used, [i], assumed, common if is_used[i] else None)
        if test is not None:
            error[i], error_sigma[i], probability[i] = test
    return Assessment(is_used, sigma, redundancy, error, error_sigma, probability, guessed, factor)


def _search(
    discrepancies: Discrepancies, assumed: float, significance: float
) -> tuple[Bool[np.ndarray, " n"], bool]:
    """Which points do not contradict the others, and whether half of all or more do, and would
    leave too few."""
    n, most_contradict = len(discrepancies), False
    is_used = np.ones(n, bool)
    fewest = max(MIN_AGREEING, (n + 1) // 2)
    while worst := _most_improbable(discrepancies, is_used, assumed, significance):
        if is_used.sum() - len(worst) < fewest:
            contradicting = (~is_used).sum() + len(worst)
            most_contradict = n > MIN_AGREEING and 2 * contradicting >= n
            break
        is_used[worst] = False
    left_out = np.flatnonzero(~is_used).tolist()
    for i in sorted(left_out, key=lambda i: -_probability(discrepancies, is_used, [i], assumed)):
        if _probability(discrepancies, is_used, [i], assumed) > level_of_one(significance, n):
            is_used[i] = True
    return is_used, most_contradict


def _most_improbable(
    discrepancies: Discrepancies,
    is_used: Bool[np.ndarray, " n"],
    assumed: float,
    significance: float,
) -> list[int]:
    """The point, or else the two points, that are most improbable; none if chance explains all."""
    rows = np.flatnonzero(is_used).tolist()
    tests_pairs = len(rows) <= MAX_POINTS_FOR_PAIRS
    # Of many points one changes the estimated σ by too little to matter.
    common = None if tests_pairs else _linearise(discrepancies, is_used, is_used, assumed)
    for tests in (
        [[i] for i in rows],
        [list(p) for p in itertools.combinations(rows, 2)] * tests_pairs,
    ):
        if tests:
            p = [_probability(discrepancies, is_used, test, assumed, common) for test in tests]
            if min(p) < level_of_one(significance, len(tests)):
                return tests[int(np.argmin(p))]
    return []


def _probability(
    discrepancies: Discrepancies,
    is_used: Bool[np.ndarray, " n"],
    tested: Sequence[int],
    assumed: float,
    model: "_WeightedDiscrepancies | None" = None,
) -> float:
    """The probability of a larger T by chance; 1 of points that cannot be tested."""
    test = _predict(discrepancies, is_used, tested, assumed, model)
    return 1.0 if test is None else test[2]


class _WeightedDiscrepancies(NamedTuple):
    """σ [n, 3] and its redundancy in the plane and in height; W and W·d of the controlled axes of
    some points, their `rows` among all axes."""

    sigma: Float[np.ndarray, "n 3"]
    redundancy: tuple[float, float]
    W: Float[np.ndarray, "m m"]
    Wd: Float[np.ndarray, " m"]
    rows: Int[np.ndarray, " m"]


def _linearise(
    discrepancies: Discrepancies,
    for_sigma: Bool[np.ndarray, " n"],
    points: Bool[np.ndarray, " n"],
    assumed: float,
) -> _WeightedDiscrepancies:
    """W and W·d of `points`, with σ estimated from `for_sigma`."""
    sigma, redundancy, _ = _resolve(discrepancies, for_sigma, assumed)
    W, d, rows = _weight_matrix(discrepancies, sigma, points)
    return _WeightedDiscrepancies(sigma, redundancy, W, W @ d, rows)


def _predict(
    discrepancies: Discrepancies,
    is_used: Bool[np.ndarray, " n"],
    tested: Sequence[int],
    assumed: float,
    model: _WeightedDiscrepancies | None = None,
) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"], float] | None:
    """Error of the prediction of the first tested point, its σ, and the probability of a larger T
    of all of them; None if the others do not predict them.

    **Arguments:** `model`: of all used points, instead of one with σ from the others."""
    if model is None:
        for_sigma, points = is_used.copy(), is_used.copy()
        for_sigma[list(tested)], points[list(tested)] = False, True
        model = _linearise(discrepancies, for_sigma, points, assumed)
    rows = model.rows
    tested_rows = np.flatnonzero(np.isin(rows // 3, tested))
    if not len(tested_rows):
        return None
    W_tested = model.W[np.ix_(tested_rows, tested_rows)]
    # W_DD is singular where the others leave D open, by G: then it is zero but for rounding.
    scale = np.abs(np.diag(W_tested)).max(initial=0.0)
    if not scale or np.linalg.eigvalsh(W_tested)[0] < 1e-9 * scale:
        return None
    covariance = np.linalg.inv(W_tested)
    e = covariance @ model.Wd[tested_rows]
    has_unknown_sigma, p = np.isnan(discrepancies.sigma).ravel()[rows[tested_rows]], []
    for height, freedom in enumerate(model.redundancy):
        part = np.flatnonzero((rows[tested_rows] % 3 == 2) == height)
        if not len(part) or (has_unknown_sigma[part].any() and freedom < MIN_REDUNDANCY_OF_TEST):
            continue  # an assumed σ tests nothing, nor one from two or three residuals
        T = float(e[part] @ np.linalg.solve(covariance[np.ix_(part, part)], e[part]))
        p.append(
            f_tail(T / len(part), len(part), freedom)
            if has_unknown_sigma[part].any()
            else chi2_tail(T, len(part))
        )
    # Bonferroni: the smaller of two probabilities counts twice. Nothing tested: chance explains it.
    p = min(1.0, len(p) * min(p)) if p else 1.0
    error, error_sigma = np.full(3, np.nan), np.full(3, np.nan)
    is_first = rows[tested_rows] // 3 == tested[0]
    axes = rows[tested_rows][is_first] % 3
    error[axes], error_sigma[axes] = e[is_first], np.sqrt(np.diag(covariance))[is_first]
    return error, error_sigma, p


def _weight_matrix(
    discrepancies: Discrepancies, sigma: Float[np.ndarray, "n 3"], is_used: Bool[np.ndarray, " n"]
) -> tuple[Float[np.ndarray, "m m"], Float[np.ndarray, " m"], Int[np.ndarray, " m"]]:
    """W and d of the controlled axes of the used points; their rows among all axes."""
    rows = np.flatnonzero((is_used[:, None] & np.isfinite(sigma)).ravel())
    n = 3 * len(discrepancies)
    S = discrepancies.covariance.reshape(n, n)[np.ix_(rows, rows)] + np.diag(
        sigma.ravel()[rows] ** 2
    )
    W = np.linalg.inv(S)
    G = discrepancies.open_motions.reshape(n, -1)[rows]
    if G.shape[1]:
        U = W @ G
        W = W - U @ np.linalg.pinv(G.T @ U, hermitian=True) @ U.T
    return W, discrepancies.difference.ravel()[rows], rows


def _resolve(
    discrepancies: Discrepancies, is_used: Bool[np.ndarray, " n"], assumed: float
) -> tuple[Float[np.ndarray, "n 3"], tuple[float, float], tuple[bool, bool]]:
    """σ of control with the unknown ones estimated from the used points, their redundancy in the
    plane and in height, and whether they had to be assumed."""
    is_unknown = np.isnan(discrepancies.sigma)
    groups = [
        is_unknown & np.array([True, True, False]),
        is_unknown & np.array([False, False, True]),
    ]
    sigma = np.where(is_unknown, assumed, discrepancies.sigma)
    estimated_groups = [g for g in groups if (g & is_used[:, None]).any()]
    redundancy = [0.0, 0.0]
    if not estimated_groups:
        return sigma, (0.0, 0.0), (bool(groups[0].any()), bool(groups[1].any()))
    start = np.abs(discrepancies.difference - np.median(discrepancies.difference[is_used], axis=0))
    for group in estimated_groups:
        sigma[group] = max(
            NORMAL_SIGMA_BY_MAD * np.median(start[group & is_used[:, None]]), assumed
        )
    # The fixed point converges linearly, slowly where C dominates; a σ to 0.1 % is far more than
    # its own σ of 10 to 40 % deserves, and after 200 rounds the last one is good enough.
    for number in range(200):
        W, d, rows = _weight_matrix(discrepancies, sigma, is_used)
        Wd, previous_sigma = W @ d, sigma.copy()
        for group in estimated_groups:
            group_rows = group.ravel()[rows]
            trace = np.diag(W)[group_rows].sum()
            if trace > 0:
                s = sigma[group][0] * np.sqrt((Wd[group_rows] ** 2).sum() / trace)
                sigma[group] = max(s, assumed)
            if number == 0:
                # With a σ that dominates C; where the estimate is small, its share is hardly any.
                redundancy[0 if group[:, :2].any() else 1] = float(
                    previous_sigma[group][0] ** 2 * trace
                )
        if np.abs(sigma[is_unknown] / previous_sigma[is_unknown] - 1).max() < 1e-3:
            break
    # For weights a relative σ of 100 % does: an assumed σ may be wrong a hundredfold.
    plane, height = (
        bool(g.any()) and (r < 0.5 or bool(np.all(sigma[g] <= assumed)))
        for g, r in zip(groups, redundancy)
    )
    for group, is_assumed in zip(groups, (plane, height)):
        if is_assumed:
            sigma[group] = assumed
    return sigma, (redundancy[0], redundancy[1]), (plane, height)
