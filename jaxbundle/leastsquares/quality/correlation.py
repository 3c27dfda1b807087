"""Correlations of unknowns, and differences in units of their covariance."""

import numpy as np
from jaxtyping import Float


def correlation_matrix(cofactor: Float[np.ndarray, "n n"]) -> Float[np.ndarray, "n n"]:
    """ρᵢⱼ = qᵢⱼ/√(qᵢᵢqⱼⱼ); 1 on the diagonal, 0 with an unknown without variance."""
    sigma = np.sqrt(np.clip(np.diagonal(cofactor), 0, None))
    scale = np.where(sigma > 0, 1 / np.where(sigma > 0, sigma, 1), 0.0)
    C = cofactor * scale[:, None] * scale[None, :]
    np.fill_diagonal(C, 1.0)
    return C


def total_correlation(cofactor: Float[np.ndarray, "n n"]) -> Float[np.ndarray, " n"]:
    """1 − 1/(C⁻¹)ᵢᵢ: the fraction of an unknown explained by the others of the group (C:
    correlations).

    The squared multiple correlation; BINGO lists it for the parameters of a camera.
    """
    C = correlation_matrix(cofactor)
    return 1 - 1 / np.diagonal(np.linalg.inv(C))


def squared_difference(d: Float[np.ndarray, " n"], C: Float[np.ndarray, "n n"]) -> float:
    """d² = dᵀC⁻¹d; in the mean n where C is the covariance of d.

    Scaled to correlations first: f and k3 differ by ten powers of ten."""
    scale = np.sqrt(np.diagonal(C))
    return float((d / scale) @ np.linalg.solve(C / np.outer(scale, scale), d / scale))
