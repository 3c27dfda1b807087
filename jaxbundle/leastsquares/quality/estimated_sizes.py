"""Sizes of error components from quadratic forms of residuals, and what it means that they are
estimates.

The forms q of the residuals have the expectations T·θ (`error_components`). Of that the θ ≥ 0 are
the solution, those left out that chance could explain. A θ = aᵀq of independent errors is a sum of
squares of few of them: with the cumulants

    κ₂ = 2·Σ a_i·a_j·T_ij,     κ₃ = 8·Σ a_i·a_j·a_l·tr(M·V_i·M·V_j·M·V_l)

its quantiles are those of the χ² distribution, shifted and scaled, that has the same three moments
(Pearson 1959; Imhof 1961). The normal quantile lets twice as many pass: a principal distance that
changes from view to view hardly shows in residuals, and chance found changes of 5 σ.

Sizes are estimates: intervals of √C times the normal quantile z hold less often than z promises.
With the covariance of the θ, a variance c = Σ θ_k·c_k has ν = 2·c²/var(c) degrees of freedom
(Satterthwaite 1946; of mixed models Kackar and Harville 1984, Kenward and Roger 1997). Covariances
are those of

    θ_k + λ·σ(θ_k),    λ = ((t_ν/z)² − 1)·c/Σ c_k·σ(θ_k)

with the medians of the unknowns of a table, and the table of the largest λ: intervals of 1.96 σ
hold 95 %, and sizes that are well determined stay as they are. One factor for all components would
make σ of points larger for the uncertain size of a field that they do not depend on.
"""

import dataclasses
from collections.abc import Iterable, Sequence

import numpy as np
from jaxtyping import Bool, Float

from jaxbundle.leastsquares.quality.distributions import (
    normal_probability,
    normal_quantile,
    skewed_quantile,
    t_quantile,
)


@dataclasses.dataclass(frozen=True)
class SizeEquations:
    """T·θ = q of an error model; `has_others`: the last component is `OTHERS`, whose θ follows
    from σ0² = q_0/T_00; `critical`: the normal quantile of the level at which components are left
    out that chance could explain; `cubes`: tr(M·V_i·M·V_j·M·V_l), of which the skewness of θ
    follows."""

    T: Float[np.ndarray, "k k"]
    has_others: bool
    critical: float = 0.0
    cubes: Float[np.ndarray, "k k k"] | None = None

    @property
    def reduced(self) -> tuple[Float[np.ndarray, "m m"], Float[np.ndarray, "m k"]]:
        """T of the estimated sizes, and the matrix that gives their q."""
        part = np.eye(len(self.T))
        if not self.has_others:
            return self.T, part
        # V_0 without the given rows, whose part of the forms is known: σ0² times their traces
        part[-1, 0] = -1
        T = part.T @ self.T @ part
        onto = part.T[:-1].copy()
        onto[:, 0] -= T[:-1, -1] / self.T[0, 0]
        return T[:-1, :-1], onto

    def solve(
        self, q: Float[np.ndarray, " k"]
    ) -> tuple[Float[np.ndarray, " k"], Float[np.ndarray, " k"]]:
        """θ ≥ 0 and the scores, of all components; the θ of `OTHERS`, which is added to that of
        all independent errors, may be negative."""
        T, onto = self.reduced
        forms = onto @ q
        cubes = self.cubes
        # Else the matrix is 1, and the product the largest part of the time.
        if cubes is not None and self.has_others:
            cubes = np.einsum("ia,jb,kc,abc->ijk", onto, onto, onto, cubes)
        theta = _significant(T, forms, self.critical, cubes)
        score = _scores(T, forms)
        if self.has_others:
            theta = np.append(theta, q[0] / self.T[0, 0] - theta[0])
            score = np.append(score, 0.0)
        return theta, score


def widening(
    theta: Float[np.ndarray, " k"],
    T: Float[np.ndarray, "m m"],
    forms: Float[np.ndarray, "m m"],
    tables: Iterable[Float[np.ndarray, "k unknowns"]],
) -> Float[np.ndarray, " k"]:
    """What θ are multiplied by in covariances because they are estimates.

    **Arguments:** `T` of the estimated sizes, the first m, and the covariance of their `forms` q;
    of every table the variances that each component of θ = 1 gives its unknowns.
    """
    return widenings(theta[None], T, forms, [parts[None] for parts in tables])[0]


def widenings(
    theta: Float[np.ndarray, "n k"],
    T: Float[np.ndarray, "m m"],
    forms: Float[np.ndarray, "m m"],
    tables: Sequence[Float[np.ndarray, "n k unknowns"]],
) -> Float[np.ndarray, "n k"]:
    """`widening` of n solutions whose sizes have the same equations."""
    factor = np.ones(theta.shape)
    positive = theta[:, : len(T)] > 0
    for pattern in np.unique(positive, axis=0):
        some = np.flatnonzero(pattern)
        if not (some > 0).any():
            continue  # independent errors alone
        # Of the θ that are not zero, in the system of these alone.
        inverse = inverse_of_traces(T[np.ix_(some, some)])
        covariance = inverse @ forms[np.ix_(some, some)] @ inverse
        sigma = np.sqrt(np.diag(covariance))
        rows = np.flatnonzero((positive == pattern).all(1))
        block = np.ix_(rows, some)
        excess = np.zeros(len(rows))
        for parts in tables:
            excess = np.maximum(excess, _excess(theta[block], covariance, parts[block]))
        factor[block] += excess[:, None] * sigma / theta[block]
    return factor


def _excess(
    theta: Float[np.ndarray, "n s"],
    covariance: Float[np.ndarray, "s s"],
    parts: Float[np.ndarray, "n s unknowns"],
    coverage: float = 0.95,
    min_degrees: float = 3.0,
) -> Float[np.ndarray, " n"]:
    """λ of a table, for intervals of a `coverage`; `min_degrees` of freedom, from which Student's
    distribution has a variance."""
    upper = 1 - (1 - coverage) / 2
    variance = (theta[:, None] @ parts)[:, 0]
    free = variance > 0
    of_variance = np.sum((covariance @ parts) * parts, 1)
    of_sigma = np.sqrt(np.diag(covariance)) @ parts
    degrees = _median(2 * variance**2, of_variance, free)
    t = np.array([t_quantile(upper, d) for d in np.maximum(degrees, min_degrees)])
    excess = ((t / normal_quantile(upper)) ** 2 - 1) * _median(variance, of_sigma, free)
    return np.where(free.any(1), excess, 0.0)


def _median(
    x: Float[np.ndarray, "n unknowns"],
    y: Float[np.ndarray, "n unknowns"],
    some: Bool[np.ndarray, "n unknowns"],
) -> Float[np.ndarray, " n"]:
    """The medians of x/y of some unknowns, 1 where there are none."""
    quotients = np.divide(x, y, out=np.full(x.shape, np.inf), where=y > 0)
    quotients = np.where(some, quotients, np.nan)
    quotients[~some.any(1)] = 1.0
    return np.nanmedian(quotients, 1)


# Relative eigenvalues of T below it are rounding: components that are combinations of others leave
# them, at 1e-16 times the number of residuals summed.
RANK_TOLERANCE = 1e-10


def inverse_of_traces(T: Float[np.ndarray, "k k"]) -> Float[np.ndarray, "k k"]:
    """T⁻¹, the pseudo-inverse where components are combinations of others."""
    return np.linalg.pinv(T, RANK_TOLERANCE, hermitian=True)


def raise_to_independent(
    forms: Float[np.ndarray, "k k"], T: Float[np.ndarray, "k k"], theta: float
) -> Float[np.ndarray, "k k"]:
    """An approximate covariance of quadratic forms, raised where it is below that of independent
    errors of the size `theta`, 2·theta²·T, which others can only add to.

    With A = MΣM ⪰ θ·M = B, of every combination V of the components

        tr(VAVA) − tr(VBVB) = tr(V(A − B)V·A) + tr(VBV·(A − B)) ≥ 0."""
    scale, L, inverse = _scaled_root(T)
    inverse = inverse / scale
    ratio, U = np.linalg.eigh(inverse @ (forms + forms.T) @ inverse.T / 2)
    root = scale[:, None] * L @ U * np.sqrt(np.maximum(ratio, 2 * theta**2))
    return root @ root.T


def _scaled_root(
    T: Float[np.ndarray, "k k"],
) -> tuple[Float[np.ndarray, " k"], Float[np.ndarray, "k r"], Float[np.ndarray, "r k"]]:
    """D, as a vector, and L of T = D·L·Lᵀ·D, with the pseudo-inverse of L. T is symmetric and
    positive semidefinite; components have different units, which D takes out."""
    scale = np.sqrt(np.where(np.diag(T) > 0, np.diag(T), 1.0))
    w, E = np.linalg.eigh(T / scale[:, None] / scale)
    some = w > RANK_TOLERANCE * w.max()
    root = np.sqrt(w[some])
    return scale, E[:, some] * root, (E[:, some] / root).T


def _nonnegative(
    T: Float[np.ndarray, "k k"], q: Float[np.ndarray, " k"]
) -> Float[np.ndarray, " k"]:
    """θ ≥ 0 of T·θ = q, in the metric of T itself (the covariance of q is 2·T for white errors)."""
    from scipy.optimize import nnls

    # T = L·Lᵀ, and ‖Lᵀθ − L⁻¹q‖ is the least-squares form
    scale, L, inverse = _scaled_root(T)
    return nnls(L.T, inverse @ (q / scale))[0] / scale


def _significant(
    T: Float[np.ndarray, "k k"],
    q: Float[np.ndarray, " k"],
    critical: float,
    cubes: Float[np.ndarray, "k k k"] | None,
) -> Float[np.ndarray, " k"]:
    """θ ≥ 0 of the components whose θ is beyond the quantile that it has in the system of all that
    are left, if errors are independent; the least significant is left out first, and one at a time:
    of two that explain the same residuals, both are short of it until one is left out."""
    # The mean square of all residuals: θ_0 may be zero, where others are in every observation.
    components, white = np.arange(len(q)), max(q[0] / T[0, 0], 0.0)
    while True:
        part = T[np.ix_(components, components)]
        theta = _nonnegative(part, q[components])
        inverse = inverse_of_traces(part)
        # The covariance of q is 2·T·σ0⁴ for independent errors.
        sigma = np.sqrt(2 * np.diag(inverse))
        limit = np.full(len(components), critical)
        if cubes is not None:
            third = 8 * np.einsum(
                "na,nb,nc,abc->n",
                inverse,
                inverse,
                inverse,
                cubes[np.ix_(components, components, components)],
            )
            level = normal_probability(critical)
            skewness = third / np.where(sigma > 0, sigma, 1.0) ** 3
            limit = np.array([skewed_quantile(level, float(g)) for g in skewness])
        limit = limit * white * sigma
        short = theta[1:] < limit[1:]
        if not short.any():
            sizes = np.zeros(len(q))
            sizes[components] = theta
            return sizes
        components = np.delete(components, 1 + np.argmin(theta[1:] / np.maximum(limit[1:], 1e-300)))


def _scores(T: Float[np.ndarray, "k k"], q: Float[np.ndarray, " k"]) -> Float[np.ndarray, " k"]:
    """How far each quadratic form exceeds that of independent errors alone, in units of its σ."""
    white = q[0] / T[0, 0]
    variance = np.diag(T) - T[:, 0] ** 2 / T[0, 0]
    excess = q - T[:, 0] * white
    # The form of the independent part determines its size: it exceeds nothing
    # (a difference of two numbers of the size of T: smaller ones are rounding).
    good = variance > 1e-9 * np.diag(T)
    return np.where(good, excess / np.sqrt(2 * np.where(good, variance, 1.0)) / white, 0.0)
