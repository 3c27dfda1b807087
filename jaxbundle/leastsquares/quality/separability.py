"""Suspicious observations that can be removed together, and those that are inseparable.

A blunder ∇_b (in σ) of observation b moves the test of observation a by

    Δw_a = −h_ab·∇_b/√r_a,    ∇_b ≈ w_b/√r_b                       Baarda (1968); Förstner (1985)

If a and b share no eliminated row, h_ab = ã·S⁻¹·b̃ᵀ with the rows reduced by elimination. So
h_ab² ≤ h̃_a·h̃_b (Cauchy and Schwarz), where h̃ is h less the part of the eliminated unknown of the
observation. With the leverage l = h̃/r

    |Δw_a| ≤ √(l_a·l_b)·|w_b|

and a can be removed together with worse ones b if its test exceeds the critical value even
without their largest possible influence. That of b is considered only if both touch the same kept
row first (the same image, say); what passes through other unknowns is neglected. Only one
observation of an eliminated row is removed at a time. These are compared by another test:
T_A = v_Aᵀ·(R_AA)⁺·v_A is the decrease of vᵀv without the observations A. If T_b is significant like
T_a, but T_ab − T_b is not, b explains everything that a does: one of them is wrong, and they cannot
be separated (separability: Förstner, 1983).

This module works on rows, groups and numbers only, not on particular observations.
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Int


def choose_together(
    tests: Float[np.ndarray, " n"],
    eliminated_row: Int[np.ndarray, " n"],
    first_kept_row: Int[np.ndarray, " n"],
    leverage: Float[np.ndarray, " n"],
    critical: float,
) -> list[int]:
    """Positions of observations that cannot mask each other through the first kept row they touch,
    the worst first.

    **Arguments:**

    - `tests`: |w| > `critical` of the candidates.
    - `eliminated_row` of each: at most one of its observations is chosen.
    - `first_kept_row`: observations that touch the same one are taken as correlated as `leverage`
      (h̃/r) allows, others as uncorrelated.
    """
    chosen: list[int] = []
    taken_rows: set[int] = set()
    influence: dict[int, float] = {}
    root = np.sqrt(leverage)
    for a in np.argsort(-tests, kind="stable").tolist():
        kept_row, eliminated = int(first_kept_row[a]), int(eliminated_row[a])
        earlier_influence = influence.get(kept_row, 0.0)
        if eliminated in taken_rows or not tests[a] - root[a] * earlier_influence > critical:
            continue
        chosen.append(a)
        taken_rows.add(eliminated)
        influence[kept_row] = float(earlier_influence + root[a] * tests[a])
    return chosen


def find_alternatives(
    design: Float[np.ndarray, "rows u"],
    residual: Float[np.ndarray, " rows"],
    observations: Sequence[Int[np.ndarray, " k"]],
    suspect: int,
    critical: float,
    critical_alone: float,
    min_redundancy: float = 1e-2,
) -> list[int]:
    """Observations that explain the same error as the suspect, so that either may be wrong.

    **Arguments:**

    - `design`, `residual`: the rows of one eliminated row, divided by their σ.
    - `observations`: the rows of each observation; `suspect` one of them.
    - `critical`: others with a test below this are not suspected.
    - `critical_alone`: the suspect is certainly wrong if its test exceeds this without the other.
    - `min_redundancy`: directions of the residuals with a smaller redundancy number carry no
      information: a hundredth of an error appears in them.
    """
    # R = I − A·A⁺: the redundancy matrix if everything else were known, which makes the residuals
    # of this eliminated row as independent as they can be. With the other unknowns free they
    # separate less well: the alternatives found here remain alternatives.
    R = np.eye(len(design)) - design @ np.linalg.pinv(design)

    def explained(*which: int) -> float:
        rows = np.concatenate([observations[i] for i in which])
        # (R_AA)⁺ by its eigenvalues: for the two rays of a point R has rank one, and the test of
        # both together is that of either.
        size, axes = np.linalg.eigh(R[np.ix_(rows, rows)])
        is_controlled = size > min_redundancy
        components = axes[:, is_controlled].T @ residual[rows]
        return float(components**2 @ (1 / size[is_controlled]))

    return [
        candidate
        for candidate in range(len(observations))
        if candidate != suspect
        and explained(candidate) > critical**2
        and explained(suspect, candidate) - explained(candidate) < critical_alone**2
    ]
